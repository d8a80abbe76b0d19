"""Decides whether another workload may have caused a failure, and how to react after that workload recovered.

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
    """Time of its last healthy output before the failure."""
    end: float | None
    """When it ended; None if no strategy was verified."""


@dataclass(frozen=True)
class UpstreamState:
    """The known state of a workload that this one depends on."""

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
        """Return the state from the workload's status and from the record next to its gate, which changes first."""
        health, since = status.health or "", unix(status.failing_since)
        recoveries = status.recoveries or []
        newest = recoveries[0] if recoveries else None
        last = None
        if newest is not None:
            moments = newest.moments
            end = unix(moments.verified) if newest.result == "Recovered" else None
            last = Recovered(newest.id, unix(moments.last_healthy) or unix(moments.detected) or 0.0, end)
        # No time limit here: dependent workloads have their own, and replacing a monitor in mid-recovery can take longer than any limit.
        if committed is not None and under_way(Committed.of(committed), listed_recoveries(recoveries)):
            health, since = "Recovering", committed.moments.get("last_healthy", committed.moments.get("detected", 0.0))
        followed = {one.name: one.recovery for one in status.dependencies or []}
        return cls(health, since, last, followed)


@dataclass(frozen=True)
class Outage:
    """The time for which others could not depend on a workload."""

    onset: float
    """Time of its last healthy output; minus infinity if that is not known."""
    end: float | None = None
    """When it ended; None while it lasts."""


def outage(before: Outage | None, upstream: UpstreamState, now: float) -> Outage | None:
    """Return the present outage of an upstream workload, or else its last known one; ``before`` is the outage known so far."""
    lasting = before if before is not None and before.end is None else None
    if upstream.failing:
        onset = upstream.failing_since
        if lasting is not None:
            return lasting if onset is None else Outage(min(lasting.onset, onset))
        return Outage(-math.inf if onset is None else onset)
    last = upstream.last
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
    """Return the failure as held if another workload may have caused it; None if the monitor acts on it now.

    ``onset`` is the time of the last healthy output and ``noticed`` when the failure was first noticed. ``outages`` has the outages of all
    upstream workloads by name.
    """
    if not depends_on:
        return None
    found: HeldFailure | None = None
    for name, known in outages.items():
        if onset < known.onset - SLACK:
            continue  # this workload failed first
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
    """Return how long a failure may take to settle, and how long it is held at most.

    A workload that is only an indirect dependency gets the longest times of all direct ones.
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
    states: Mapping[str, UpstreamState],
    outages: Mapping[str, Outage],
    *,
    followed: Mapping[str, str],
    now: float,
) -> DueReaction | None:
    """Return the recoveries to which this workload must react now; None if there are none, or if other workloads come first.

    ``followed`` has, by name, the recoveries to which it has reacted already. The reaction waits until every dependency that had a new
    recovery is healthy and until every upstream workload has made its own reaction. So workloads react in the order of the graph, once for
    all recoveries before them, and independent workloads react at the same time. An upstream workload that never settles delays the
    reaction by no more than ``waitFor``.
    """
    pending = {
        one.name: last
        for one in depends_on
        if one.name in followed and (last := _last(states, one.name)) is not None and last.id != followed[one.name]
    }
    if not pending or any(states[name].failing for name in pending):
        return None
    since = max(_over(last, outages.get(name)) for name, last in pending.items())
    patience = max(seconds(one.wait_for) for one in depends_on if one.name in pending)
    if now < since + patience and any(_unsettled(upstream, states)):
        return None
    return DueReaction([DependencyRecovery(name=name, recovery=last.id) for name, last in pending.items()], since)


def _last(states: Mapping[str, UpstreamState], name: str) -> Recovered | None:
    return states[name].last if name in states else None


def _over(last: Recovered, known: Outage | None) -> float:
    """Return when a workload was healthy again."""
    if last.end is not None:
        return last.end
    return known.end if known is not None and known.end is not None else last.onset


def _unsettled(upstream: Sequence[Upstream], states: Mapping[str, UpstreamState]) -> Iterator[bool]:
    for one in upstream:
        known = states.get(one.name, UpstreamState())
        yield known.failing
        for name in one.depends_on:
            last = _last(states, name)
            yield last is not None and name in known.followed and known.followed[name] != last.id
