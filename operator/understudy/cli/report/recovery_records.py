"""Evaluates the recoveries of a fleet in a period from the records in the status of the RobotWorkloads. Pure.

A status records the last ten recoveries. Figures of a robot therefore refer to the time for which its records are complete.
Times are in unix seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any

from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.cli.common.robots import Robot, robot, status_of
from understudy.cli.common.text.recovery_text import parts_of, start_of
from understudy.cli.common.text.time_bars import NAMES
from understudy.cli.common.text.wording import unix
from understudy.cli.report.reserved_resources import Share, shares
from understudy.cli.report.sample_statistics import Spread


@dataclass(frozen=True)
class Span:
    """A time interval."""

    begin: float
    end: float

    @property
    def length(self) -> float:
        """In seconds."""
        return self.end - self.begin

    def within(self, other: Span) -> Span | None:
        """Return the intersection with another interval; None if it is empty."""
        begin, end = max(self.begin, other.begin), min(self.end, other.end)
        return Span(begin, end) if begin < end else None


@dataclass(frozen=True)
class Outage:
    """An interval in which a robot had no working active instance."""

    span: Span
    at_least: bool = False
    """Whether it may have lasted longer, because its end was not recorded."""


@dataclass(frozen=True)
class Entry:
    """One recovery of one robot."""

    namespace: str
    name: str
    recovery: Recovery
    began: float

    @property
    def group(self) -> str:
        """The group in which it is compared: the same strategy, separate from recoveries without a failure of this robot."""
        recovery = self.recovery
        if recovery.switchover is not None:
            return f"{recovery.strategy}, {recovery.switchover.lower()} as planned"
        if recovery.follows:
            return f"{recovery.strategy}, after a dependency's"
        return f"{recovery.strategy}{', switched over as planned' if recovery.planned else ''}"

    @property
    def of_failure(self) -> bool:
        """Whether a failure of this workload caused it: it was neither planned nor followed another workload's recovery."""
        return not self.recovery.planned and not self.recovery.follows

    @property
    def recovered(self) -> bool:
        """Whether an understudy took over."""
        return self.recovery.result == "Recovered"

    @property
    def failed(self) -> bool:
        """Whether every strategy failed."""
        return self.recovery.result == "Failed"

    @property
    def held(self) -> float:
        """Seconds for which the policy's budget deferred it, which are in none of its parts."""
        moments = self.recovery.moments
        if moments.released is None or moments.detected is None:
            return 0.0
        return max(0.0, unix(moments.released) - unix(moments.detected))

    @property
    def down(self) -> float:
        """Seconds from the last healthy output until an understudy could reach the robot; for a failed recovery, as far as recorded."""
        duration = self.recovery.recovery_seconds
        return (duration if duration is not None else sum(parts_of(self.recovery).values())) + self.held

    @property
    def gap(self) -> float | None:
        """Seconds between the last healthy output and the next instance's first one, as the monitor received them."""
        moments = self.recovery.moments
        last = moments.last_output or moments.last_healthy
        if not self.recovered or last is None or moments.first_output is None:
            return None
        return max(0.0, unix(moments.first_output) - unix(last))


@dataclass(frozen=True)
class RobotPeriod:
    """One robot in the period."""

    robot: Robot
    ever: int
    """Number of recoveries since its creation."""
    kept: int
    """Number of recorded recoveries."""
    entries: Sequence[Entry]
    """Recoveries that began in the period, newest first."""
    known: Span | None
    """The part of the period for which the records are complete; None if there is none."""
    outages: Sequence[Outage]
    """Its outages within the recorded time."""

    @property
    def forgotten(self) -> int:
        """Number of recoveries that are no longer recorded."""
        return self.ever - self.kept

    @cached_property
    def down(self) -> float:
        """Downtime in seconds within the recorded time."""
        total, end = 0.0, float("-inf")
        for span in sorted((outage.span for outage in self.outages), key=lambda span: span.begin):
            total += max(0.0, span.end - max(span.begin, end))
            end = max(end, span.end)
        return total

    @property
    def down_at_least(self) -> bool:
        """Whether the downtime may have been longer."""
        return any(outage.at_least for outage in self.outages)

    @property
    def availability(self) -> float | None:
        """The share of the recorded time without an outage; None if nothing is recorded."""
        return 1 - self.down / self.known.length if self.known is not None else None


@dataclass(frozen=True)
class Group:
    """Recoveries of one kind, for comparison."""

    name: str
    entries: Sequence[Entry]

    @cached_property
    def parts(self) -> Mapping[str, float]:
        """The mean of each part, in seconds."""
        return {part: fmean(parts_of(entry.recovery).get(part, 0.0) for entry in self.entries) for part in NAMES}

    @cached_property
    def times(self) -> Sequence[float]:
        """The recovery time of each, in seconds."""
        return [entry.recovery.recovery_seconds or 0.0 for entry in self.entries]

    @cached_property
    def spread(self) -> Spread:
        """Statistics of the recovery times."""
        return Spread.of(self.times)

    @cached_property
    def gaps(self) -> Sequence[float]:
        """The recorded gaps in seconds."""
        return [gap for entry in self.entries if (gap := entry.gap) is not None]


@dataclass(frozen=True)
class Findings:
    """The evaluation of all robots."""

    period: Span
    robot_periods: Sequence[RobotPeriod]
    """By namespace and name."""
    shares: Sequence[Share] = ()
    """Current resource requests of their pods."""
    shares_unknown: str = ""
    """Why the pods could not be listed, if so."""

    @cached_property
    def entries(self) -> Sequence[Entry]:
        """The recoveries of all robots, newest first."""
        return sorted(
            (e for robot_period in self.robot_periods for e in robot_period.entries),
            key=lambda e: e.began,
            reverse=True,
        )

    @cached_property
    def eventful(self) -> Sequence[RobotPeriod]:
        """The robots with a recovery or an outage in the period."""
        return [robot_period for robot_period in self.robot_periods if robot_period.entries or robot_period.outages]

    @cached_property
    def groups(self) -> Sequence[Group]:
        """Successful recoveries by group, the slowest group first, as in the paper."""
        found: dict[str, list[Entry]] = {}
        for entry in self.entries:
            if entry.recovered:
                found.setdefault(entry.group, []).append(entry)
        groups = [Group(name, entries) for name, entries in found.items()]
        return sorted(groups, key=lambda group: (-group.spread.mean, group.name))

    @cached_property
    def incomplete(self) -> Sequence[RobotPeriod]:
        """Robots for which recoveries of this period may no longer be recorded."""
        return [
            robot_period
            for robot_period in self.robot_periods
            if robot_period.known is None or robot_period.known.begin > self._since(robot_period)
        ]

    @cached_property
    def availability(self) -> float | None:
        """The share of all robots' recorded time without an outage."""
        known = sum(robot_period.known.length for robot_period in self.robot_periods if robot_period.known is not None)
        return 1 - sum(robot_period.down for robot_period in self.robot_periods) / known if known else None

    def named(self, whose: Robot | Entry) -> str:
        """Return a robot's name, with its namespace if there are several namespaces."""
        several = len({robot_period.robot.namespace for robot_period in self.robot_periods}) > 1
        return f"{whose.namespace}/{whose.name}" if several else whose.name

    def _since(self, robot_period: RobotPeriod) -> float:
        created = robot_period.robot.created
        return max(self.period.begin, unix(created) if created else self.period.begin)


def findings(
    items: Iterable[Mapping[str, Any]], period: Span, pods: Iterable[Mapping[str, Any]] = (), *, pods_unknown: str = ""
) -> Findings:
    """Evaluate RobotWorkloads and pods for a period; ``pods_unknown`` says why the pods are missing.

    Raises CommandError if a status does not match this version.
    """
    robot_periods = sorted(
        (robot_period(item, period) for item in items), key=lambda one: (one.robot.namespace, one.robot.name)
    )
    found = [] if pods_unknown else shares([one.robot for one in robot_periods], pods)
    return Findings(period, robot_periods, found, pods_unknown)


def robot_period(item: Mapping[str, Any], period: Span) -> RobotPeriod:
    """Evaluate one RobotWorkload for a period. Raises CommandError."""
    shown, status = robot(item), status_of(item)
    records = [
        Entry(shown.namespace, shown.name, recovery, unix(start))
        for recovery in status.recoveries or []
        if (start := start_of(recovery)) is not None
    ]
    kept, ever = len(status.recoveries or []), max(status.recovery_count or 0, len(status.recoveries or []))
    begin = max(period.begin, unix(shown.created)) if shown.created else period.begin
    if ever > kept:
        begin = max(begin, min((entry.began for entry in records), default=period.end))
    known = Span(begin, period.end).within(period)
    return RobotPeriod(
        robot=shown,
        ever=ever,
        kept=kept,
        entries=[entry for entry in records if period.begin <= entry.began < period.end],
        known=known,
        outages=[
            Outage(span, one.at_least)
            for one in _outages(records, status, period.end)
            if known is not None and (span := one.span.within(known)) is not None
        ],
    )


def _outages(records: Sequence[Entry], status: RobotWorkloadStatus, end: float) -> Iterator[Outage]:
    """Yield the outages of the records, newest first, and of the failure that continues at ``end``."""
    for index, entry in enumerate(records):
        outage = Span(entry.began, entry.began + entry.down)
        if (
            not entry.failed or entry.recovery.switchover is not None
        ):  # after a failed switchover the former instance keeps control
            yield Outage(outage)
        elif index:  # the next record continues it
            yield Outage(outage, at_least=records[index - 1].began > outage.end)
        elif status.failing_since is not None:
            yield Outage(outage)
        else:
            healthy = _healthy_since(status)
            over = healthy is not None and healthy >= entry.began
            yield Outage(Span(entry.began, healthy) if over and healthy is not None else outage, at_least=not over)
    if status.failing_since is not None and (since := unix(status.failing_since)) < end:
        yield Outage(Span(since, end))


def _healthy_since(status: RobotWorkloadStatus) -> float | None:
    found = next((c for c in status.conditions or [] if c.type == "Healthy" and c.status == "True"), None)
    return unix(found.last_transition_time) if found is not None else None
