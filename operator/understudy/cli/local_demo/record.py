"""What the journals of the robot and of the monitor say, and what they prove about a failover. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import NamedTuple

from understudy.cli.local_demo.journals import Entry


class Command(NamedTuple):
    """A command that reached the robot."""

    at: float
    """When, in seconds of the monotonic clock."""
    source: str
    """The instance that sent it."""


@dataclass
class RobotRecord:
    """What the robot recorded. All times are seconds of the monotonic clock."""

    commands: list[Command] = field(default_factory=list)
    stops: list[float] = field(default_factory=list)
    """When the robot stopped by itself, because no command arrived."""
    position: tuple[float, float] = (0.0, 0.0)
    """In m."""
    speed: float = 0.0
    """In m/s."""

    def add(self, entries: Iterable[Entry]) -> None:
        """Add entries of the journal."""
        for entry in entries:
            if "source" in entry:
                self.commands.append(Command(entry["at"], entry["source"]))
            elif "stopped" in entry:
                self.stops.append(entry["at"])
            else:
                self.position, self.speed = (entry["x"], entry["y"]), entry["speed"]

    def received(self, source: str, *, since: float, until: float) -> int:
        """Return how many commands of an instance arrived in an interval."""
        found = 0
        for command in reversed(self.commands):
            if command.at < since:
                break
            found += command.source == source and command.at < until
        return found

    @property
    def drivers(self) -> list[str]:
        """Who drove, in order: a name comes again only if somebody else drove in between."""
        return [source for source, _ in groupby(command.source for command in self.commands)]


class Detection(NamedTuple):
    """A failure that the health tree found."""

    at: float
    """When, in seconds of the monotonic clock."""
    instance: str
    reason: str


class Decision(NamedTuple):
    """A change of control."""

    at: float
    """When, in seconds of the monotonic clock."""
    instance: str
    """Who is in control from then on."""


@dataclass
class MonitorRecord:
    """What the monitor recorded."""

    health: str = "Starting"
    reason: str = ""
    active: str = ""
    sends: Mapping[str, float] = field(default_factory=dict)
    """Commands per second that each instance sends, whether they reach the robot or not."""
    sent: Mapping[str, int] = field(default_factory=dict)
    """Commands that each instance has sent since it was first heard."""
    detections: list[Detection] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add(self, entries: Iterable[Entry]) -> None:
        """Add entries of the journal."""
        for entry in entries:
            if "health" in entry:
                self.health, self.reason = entry["health"], entry["reason"]
                self.active, self.sends, self.sent = entry["active"], entry["sends"], entry["sent"]
            elif "detected" in entry:
                self.detections.append(Detection(entry["at"], entry["detected"], entry["reason"]))
            elif "control" in entry:
                self.active = entry["control"]
                self.decisions.append(Decision(entry["at"], self.active))
            elif "problem" in entry:
                self.problems.append(entry["problem"])


@dataclass
class Failover:
    """One failure, by the robot's record. All times are seconds of the monotonic clock."""

    frozen: str
    frozen_at: float
    standby: str
    last: float
    """When the last command of the frozen instance arrived."""
    first: float | None
    """When the first command of the standby arrived; None if none did in time."""
    reason: str
    """Why the health tree failed; empty if it did not."""
    stopped: bool
    """Whether the robot stopped by itself in between."""
    sent: int = 0
    """Commands that the frozen instance sent after it was woken up, as long as it was watched; 0 if it was in control again."""
    leaked: int = 0
    """Commands of the frozen instance that reached the robot after it was woken up, and was not in control again."""

    @property
    def gap(self) -> float | None:
        """Seconds without a command at the robot; None if no standby took over."""
        return None if self.first is None else self.first - self.last


def leaked(robot: RobotRecord, monitor: MonitorRecord, woken: str, since: float, until: float) -> int:
    """Return how many commands of an instance reached the robot in an interval before it was put in control again."""
    again = min((one.at for one in monitor.decisions if one.instance == woken and one.at > since), default=until)
    return robot.received(woken, since=since, until=min(again, until))


def one_at_a_time(robot: RobotRecord, monitor: MonitorRecord) -> bool:
    """Whether the robot was driven by the instances in the order in which they were put in control, and never by two in turns."""
    decided = iter(one.instance for one in monitor.decisions)
    return all(driver in decided for driver in robot.drivers)


def failover(robot: RobotRecord, monitor: MonitorRecord, frozen: str, frozen_at: float, standby: str) -> Failover:
    """Return what the records say so far about an instance that was frozen."""
    last = max((one.at for one in robot.commands if one.source == frozen), default=frozen_at)
    first = next((one.at for one in robot.commands if one.source == standby and one.at > frozen_at), None)
    reason = next((one.reason for one in monitor.detections if one.instance == frozen and one.at > frozen_at), "")
    stopped = any(last < at and (first is None or at < first) for at in robot.stops)
    return Failover(frozen, frozen_at, standby, last, first, reason, stopped)
