"""A recovery as the robot saw it: which pod's commands arrived when, and when none arrived.

The cluster's answers say what was intended. Whether two pods ever drove at once, whether a standby leaked through
before the switch and how long the robot was alone can only be said where commands arrive, so all of it is computed from
the log that the quickstart's robot keeps. All times are unix seconds, taken by the robot's DDS reader at reception.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

LIFESPAN = 0.1
"""Seconds after which a writer drops a command that the robot has not received: the default of ``spec.outputs[].lifespan``."""


@dataclass(frozen=True, slots=True)
class Command:
    """One command as it reached the robot."""

    received: float
    source: str
    """Pod that sent it."""
    sequence: int
    """Counts the robot's received commands from 1."""
    sent: float
    """When the sender's DDS writer took it, by the sender's clock."""
    linear: float
    angular: float
    x: float
    y: float
    heading: float
    speed: float
    """The robot's own forward speed at that moment, in m/s."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Where the robot was and how it moved."""

    time: float
    x: float
    y: float
    heading: float
    speed: float
    turn: float
    held: bool
    """Whether the robot's own command watchdog held it, because no commands arrive."""


@dataclass(frozen=True, slots=True)
class Silence:
    """An interval between two consecutive commands of whatever source."""

    start: float
    end: float
    before: str
    after: str

    @property
    def seconds(self) -> float:
        """Its length."""
        return self.end - self.start


@dataclass(frozen=True, slots=True)
class Reign:
    """The commands of one source, from its first to its last."""

    source: str
    first: float
    last: float
    count: int


@dataclass(frozen=True, slots=True)
class Handover:
    """Control passing from one pod to another, at the robot."""

    old: str
    new: str
    last_old: float | None
    """Last command of the old pod that ever arrived; None where none did."""
    first_new: float | None
    """First command of the new pod since the switch; None where none arrived."""
    gap: float | None
    """The robot's time without commands: from the last one of any source to the first of the new pod."""
    overlap: float
    """Time over which both pods' commands arrived: from the first of the new pod to the last of the old one, or 0."""
    late: tuple[Command, ...] = ()
    """Commands of the old pod that arrived after the first of the new one."""
    early: tuple[Command, ...] = ()
    """Commands of the new pod that arrived before the switch: leaks."""
    trailing: float = 0.0
    """How long after the switch the old pod's commands still arrived, or 0."""
    stale: tuple[Command, ...] = ()
    """Commands of the new pod that arrived after the switch, and were sent more than LIFESPAN before it."""

    @property
    def clean(self) -> bool:
        """Whether the new pod's commands arrived, none of them early or stale, and none of the old pod's after them."""
        return self.first_new is not None and not self.early and not self.stale and not self.late

    def to_json(self) -> dict[str, Any]:
        """For reports; commands as their reception times."""
        return {
            "old": self.old,
            "new": self.new,
            "lastOld": self.last_old,
            "firstNew": self.first_new,
            "gapSeconds": self.gap,
            "overlapSeconds": self.overlap,
            "trailingSeconds": self.trailing,
            "lateCommands": [c.received for c in self.late],
            "earlyCommands": [c.received for c in self.early],
            "staleCommands": [[c.sent, c.received] for c in self.stale],
        }


@dataclass
class RobotLog:
    """Everything the robot wrote down, in the order of reception."""

    commands: list[Command] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)

    def sources(self) -> list[str]:
        """The pods whose commands arrived, in the order of their first one."""
        return list(dict.fromkeys(c.source for c in self.commands))

    def of(self, source: str) -> list[Command]:
        """The commands of one pod."""
        return [c for c in self.commands if c.source == source]

    def times(self) -> dict[str, list[float]]:
        """Reception times by pod."""
        times: dict[str, list[float]] = {}
        for command in self.commands:
            times.setdefault(command.source, []).append(command.received)
        return times

    def reigns(self) -> list[Reign]:
        """From when to when each pod's commands arrived, in the order of their first one."""
        return [Reign(source, times[0], times[-1], len(times)) for source, times in self.times().items()]

    def between(self, start: float, end: float) -> RobotLog:
        """The part from ``start`` (included) to ``end`` (excluded)."""
        first = bisect_left(self.commands, start, key=lambda c: c.received)
        last = bisect_left(self.commands, end, key=lambda c: c.received)
        return RobotLog(self.commands[first:last], [m for m in self.motions if start <= m.time < end])

    def renamed(self, names: Mapping[str, str]) -> RobotLog:
        """The same with other names for sources; those without one keep theirs.

        A robot whose commands do not say who sent them knows hosts only (``understudy.ros.observe.sample_sources``), not pods.
        """
        return RobotLog([replace(c, source=names.get(c.source, c.source)) for c in self.commands], self.motions)

    def silences(self, longer_than: float = 0.0) -> list[Silence]:
        """Intervals without any command, longer than so many seconds."""
        return [
            Silence(a.received, b.received, a.source, b.source)
            for a, b in pairwise(self.commands)
            if b.received - a.received > longer_than
        ]

    def longest_silence(self) -> Silence | None:
        """The longest interval without any command; None with fewer than two commands."""
        return max(self.silences(-1.0), key=lambda s: s.seconds, default=None)

    def leaks(self, source: str, before: float) -> list[Command]:
        """Commands of a pod that arrived before a moment, such as the one at which it was given control."""
        return [c for c in self.commands if c.source == source and c.received < before]

    def returns(self) -> list[Command]:
        """Commands of a pod that arrived after a later pod had driven.

        Control only ever moves on to a pod that never drove before, so each of these is a moment at which two pods were
        driving. It needs no other clock than the robot's.
        """
        order = {source: number for number, source in enumerate(self.sources())}
        newest = -1
        found = []
        for command in self.commands:
            number = order[command.source]
            if number < newest:
                found.append(command)
            newest = max(newest, number)
        return found

    def handover(self, old: str, new: str, *, switch: float | None = None) -> Handover:
        """How control passed from ``old`` to ``new``.

        ``switch`` is the earliest moment at which ``new`` may have been given control; without it nothing is early or stale.
        """
        theirs = self.of(old)
        ours = self.of(new)
        early = [] if switch is None else [c for c in ours if c.received < switch]
        last_old = theirs[-1].received if theirs else None
        if len(early) == len(ours):
            return Handover(old, new, last_old, None, None, 0.0, early=tuple(early), trailing=_since(switch, last_old))
        first = ours[len(early)]
        index = self.commands.index(first)
        late = [c for c in theirs if c.received > first.received]
        stale = [] if switch is None else [c for c in ours[len(early) :] if c.sent < switch - LIFESPAN]
        return Handover(
            old=old,
            new=new,
            last_old=last_old,
            first_new=first.received,
            gap=first.received - self.commands[index - 1].received if index else None,
            overlap=late[-1].received - first.received if late else 0.0,
            late=tuple(late),
            early=tuple(early),
            trailing=_since(switch, last_old),
            stale=tuple(stale),
        )


def _since(start: float | None, end: float | None) -> float:
    return 0.0 if start is None or end is None else max(0.0, end - start)


def parse(text: str | Iterable[str]) -> RobotLog:
    """The robot's log from its text or lines.

    Lines that are not records are left out: a pod's log has others among them, and its first or last one may be cut off.
    """
    log = RobotLog()
    for line in text.splitlines() if isinstance(text, str) else text:
        record = _record(line)
        try:
            match record.get("event"):
                case "command":
                    log.commands.append(_command(record))
                case "odometry":
                    log.motions.append(_motion(record))
        except (KeyError, TypeError, ValueError):
            continue
    log.commands.sort(key=lambda c: c.received)
    log.motions.sort(key=lambda m: m.time)
    return log


def _record(line: str) -> dict[str, Any]:
    start = line.find("{")
    if start < 0:
        return {}
    try:
        record = json.loads(line[start:])
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _command(record: dict[str, Any]) -> Command:
    return Command(
        received=float(record["received"]),
        source=str(record["source"]),
        sequence=int(record["sequence"]),
        sent=float(record["sent"]),
        linear=float(record["linear"]),
        angular=float(record["angular"]),
        x=float(record["x"]),
        y=float(record["y"]),
        heading=float(record["heading"]),
        speed=float(record["speed"]),
    )


def _motion(record: dict[str, Any]) -> Motion:
    return Motion(
        time=float(record["time"]),
        x=float(record["x"]),
        y=float(record["y"]),
        heading=float(record["heading"]),
        speed=float(record["speed"]),
        turn=float(record["turn"]),
        held=bool(record["held"]),
    )
