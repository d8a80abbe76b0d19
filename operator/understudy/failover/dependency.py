"""Whether a failure may be caused by the failure of another workload, and what to do after that one recovered.

Workloads that depend on each other fail together: if localization falls silent, so does the planner, and the planner's monitor sees only
that. The status of the other workloads and the records next to their gates show which of them failed first. Pure: times are unix seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import Dependency, DependencyRecovery, RobotWorkloadStatus
from understudy.api.moments import unix
from understudy.api.protocol.monitor_settings import Upstream
from understudy.failover.progress import Committed, Progress, listed_recoveries, under_way

SLACK = 0.1
"""Maximum seconds that an effect may seem to come before its cause: the clocks of two nodes differ, and messages take time."""

FAILING = ("Starting", "Failed", "Recovering")
"""Health of a workload that others cannot depend on. Unknown is not one of them: the workload may have no monitor."""


@dataclass(frozen=True)
class Recovered:
    """The newest recovery of a workload."""

    id: str
    onset: float
    """Its last healthy output before."""
    end: float | None
    """When it ended; None if nothing was verified."""


@dataclass(frozen=True)
class UpstreamState:
    """What is known of a workload that this one depends on."""

    health: str = ""
    """As its monitor reported last; empty if the workload does not exist."""
    failing_since: float | None = None
    """Its last healthy output before the present failure, if that is known."""
    last: Recovered | None = None
    followed: Mapping[str, str] = field(default_factory=dict)
    """By name, the recoveries of its own dependencies to which it has reacted."""

    @property
    def failing(self) -> bool:
        """Whether others cannot depend on it now."""
        return self.health in FAILING

    @classmethod
    def of(cls, status: RobotWorkloadStatus, committed: Progress | None) -> UpstreamState:
        """Return it from the status, and from the record next to its gate, which changes first."""
        health, since = status.health or "", unix(status.failing_since)
        recoveries = status.recoveries or []
        newest = recoveries[0] if recoveries else None
        last = None
        if newest is not None:
            moments = newest.moments
            end = unix(moments.verified) if newest.result == "Recovered" else None
            last = Recovered(newest.id, unix(moments.last_healthy) or unix(moments.detected) or 0.0, end)
        # Without a bound: who depends on it has its own, and a monitor that is replaced in the midst of it takes longer than any.
        if committed is not None and under_way(Committed.of(committed), listed_recoveries(recoveries)):
            health, since = "Recovering", committed.moments.get("last_healthy", committed.moments.get("detected", 0.0))
        followed = {one.name: one.recovery for one in status.dependencies or []}
        return cls(health, since, last, followed)


@dataclass(frozen=True)
class Outage:
    """The time for which others could not depend on a workload."""

    onset: float
    """Its last healthy output; minus infinity if that is not known."""
    end: float | None = None
    """When it ended; None while it lasts."""


def outage(before: Outage | None, seen: UpstreamState, now: float) -> Outage | None:
    """The present outage of a workload upstream, or else the last one that is known; ``before`` is what was known until now."""
    lasting = before if before is not None and before.end is None else None
    if seen.failing:
        onset = seen.failing_since
        if lasting is not None:
            return lasting if onset is None else Outage(min(lasting.onset, onset))
        return Outage(-math.inf if onset is None else onset)
    last = seen.last
    if lasting is not None:
        recovered = last is not None and last.end is not None and last.end >= lasting.onset
        return Outage(lasting.onset, last.end if recovered and last is not None else now)
    if last is not None and last.end is not None and (before is None or before.end is None or last.end > before.end):
        return Outage(last.onset, last.end)
    return before


@dataclass(frozen=True)
class HeldFailure:
    """A failure that is not acted on yet."""

    until: float
    """When it is acted on, if it lasts."""
    name: str = ""
    """The workload whose failure may be the cause; empty while the monitor only waits to see whether there is one."""
    settling: bool = False
    """Whether that workload is healthy again."""


def held(
    onset: float,
    noticed: float,
    now: float,
    *,
    depends_on: Sequence[Dependency],
    outages: Mapping[str, Outage],
) -> HeldFailure | None:
    """Whether a failure with its last healthy output at ``onset`` isn't acted on yet, since it may follow from another's.

    ``noticed`` is when it was noticed first; ``outages`` are those of all workloads upstream, by name.
    """
    if not depends_on:
        return None
    found: HeldFailure | None = None
    for name, known in outages.items():
        if onset < known.onset - SLACK:
            continue  # it was first
        settle, wait = _patience(name, depends_on)
        until = noticed + wait
        if known.end is not None:
            if onset > known.end + settle:
                continue
            until = min(until, known.end + settle)
        if until > now and (found is None or until > found.until):
            found = HeldFailure(until, name, known.end is not None)
    if found is not None:
        return found
    until = noticed + max(seconds(one.notice_within) for one in depends_on)
    return HeldFailure(until) if until > now else None


def _patience(name: str, depends_on: Sequence[Dependency]) -> tuple[float, float]:
    """How long a failure may take to settle, and how long it is held at most. What is depended on through others has the
    longest times of all.
    """
    direct = [one for one in depends_on if one.name == name] or depends_on
    return max(seconds(one.settle_within) for one in direct), max(seconds(one.wait_for) for one in direct)


@dataclass(frozen=True)
class DueReaction:
    """A reaction that is due now because other workloads recovered."""

    follows: list[DependencyRecovery]
    since: float
    """When the last of them recovered."""


def due(
    depends_on: Sequence[Dependency],
    upstream: Sequence[Upstream],
    seen: Mapping[str, UpstreamState],
    outages: Mapping[str, Outage],
    *,
    followed: Mapping[str, str],
    now: float,
) -> DueReaction | None:
    """Return the recoveries after which something is due now; None if there are none, or if others come first.

    ``followed`` are those after which it was done. It waits for each of those that are recovered, and for each upstream that has to do
    something after a recovery itself: so each is done in the order of the graph, once for all that came before, and at the same time
    as by those that don't depend on each other. One that never gets there is waited for no longer than ``waitFor``.
    """
    pending = {
        one.name: last
        for one in depends_on
        if one.name in followed and (last := _last(seen, one.name)) is not None and last.id != followed[one.name]
    }
    if not pending or any(seen[name].failing for name in pending):
        return None
    since = max(_over(last, outages.get(name)) for name, last in pending.items())
    patience = max(seconds(one.wait_for) for one in depends_on if one.name in pending)
    if now < since + patience and any(_unsettled(upstream, seen)):
        return None
    return DueReaction([DependencyRecovery(name=name, recovery=last.id) for name, last in pending.items()], since)


def _last(seen: Mapping[str, UpstreamState], name: str) -> Recovered | None:
    return seen[name].last if name in seen else None


def _over(last: Recovered, known: Outage | None) -> float:
    """Return when a workload was healthy again."""
    if last.end is not None:
        return last.end
    return known.end if known is not None and known.end is not None else last.onset


def _unsettled(upstream: Sequence[Upstream], seen: Mapping[str, UpstreamState]) -> Iterator[bool]:
    for one in upstream:
        known = seen.get(one.name, UpstreamState())
        yield known.failing
        for name in one.depends_on:
            last = _last(seen, name)
            yield last is not None and name in known.followed and known.followed[name] != last.id
