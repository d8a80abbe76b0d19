"""What must hold of the instances that a robot hears, and of what its monitor says of that."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from tests.unit.interleavings.pods import Running
from understudy.failover.protocol import PERIOD_MOST

NOTICED = 4.0
"""Seconds after which a monitor has noticed a second driver: one counts after a second, and monitors look once a second."""

BEFORE = 0.05
"""Seconds besides a period of its samples for which another instance was heard before it counts that a recovery is verified."""

JUST_NOW = 0.2
"""Minimum seconds after a sample of an instance in which its robot receives no safe command; a period of its samples, if that is longer."""

ENDED = 30.0
"""Seconds after which a second driver has ended or been fenced, if nothing prevents its monitor."""


@dataclass(frozen=True)
class Says:
    """What a monitor says of its robot."""

    who: str
    health: str
    sole: str
    """Status of the condition SoleDriver."""
    recovered_at: float
    """When (Unix seconds) a recovery was last under way."""
    unhindered_since: float
    """Since when (Unix seconds) nothing has kept it from noticing. If it learns late that another monitor has switched the gate, another
    instance is the second driver from then on, and it may still be what the network needs to enforce the change."""
    acts_since: float
    """Since when (Unix seconds) it also reaches the API server."""
    knows: frozenset[str] = frozenset()
    """UIDs of the instances that it knows. One that came or went while it was cut off, or before it began, may be a stranger to it."""
    has_gate: bool = True
    """Whether it knows a gate object. Without one, nothing says who may drive."""


@dataclass
class Drive:
    """A time in which a robot heard an instance. Times are Unix seconds."""

    name: str
    period: float
    since: float
    until: float = math.inf


class Drivers:
    """No second driver stays unnoticed."""

    def __init__(
        self,
        clock: Callable[[], float],
        broken: Callable[[str], None],
        heard: Callable[[str], Sequence[Running]],
        ends: Callable[[Running], bool],
    ) -> None:
        """``heard`` returns the instances that a robot hears now; ``ends`` whether a cluster can end or fence one."""
        self._clock, self._broken, self._heard, self._ends = clock, broken, heard, ends
        self._since: dict[str, float] = {}
        """By robot, since when there are two."""
        self._endable: dict[str, float] = {}
        """By UID, since when a cluster can end or fence an instance."""
        self._drives: dict[str, dict[str, list[Drive]]] = {}
        """By robot and UID."""
        self._recorded: set[str] = set()
        self.knew: Callable[[str, float], Collection[str]] = lambda who, at: ()
        """Returns the UIDs of the instances that a monitor knew at a time. It reports others as unknown senders, and does no more about
        them."""
        self.doubled = self.safe_commands = 0
        """Seconds for which robots had a second driver, and safe commands that robots received."""

    def routed(self, robot: str) -> None:
        """What a robot hears has changed."""
        heard, drives = {found.uid: found for found in self._heard(robot)}, self._drives.setdefault(robot, {})
        for uid, found in drives.items():
            if uid not in heard:
                found[-1].until = min(found[-1].until, self._clock())
        for uid, one in heard.items():
            known = drives.setdefault(uid, [])
            if known and known[-1].period != one.period:
                known[-1].until = min(known[-1].until, self._clock())
            if not known or known[-1].until < math.inf:
                known.append(Drive(one.name, one.period, self._clock()))
        if len(heard) > 1:
            self._since.setdefault(robot, self._clock())
        else:
            self._since.pop(robot, None)

    def recorded(self, robot: str, recovery: Mapping[str, Any], by: str) -> None:
        """A recovery was recorded. While others are heard, it is not recorded as Recovered."""
        if recovery["id"] in self._recorded or recovery["result"] != "Recovered":
            return
        self._recorded.add(recovery["id"])
        verified = datetime.fromisoformat(recovery["moments"]["verified"]).timestamp()
        known = self.knew(by, verified - BEFORE)
        for drive in (drive for uid, drives in self._drives.get(robot, {}).items() if uid in known for drive in drives):
            if drive.name == recovery["toPod"] or drive.period > PERIOD_MOST:
                continue
            if drive.since <= verified - drive.period - BEFORE and drive.until > verified:
                self._broken(
                    f"{by} records recovery {recovery['id']} of {robot} as Recovered, and {drive.name} drives it too "
                    f"since {verified - drive.since:.1f} s"
                )

    def commanded_safely(self, robot: str) -> None:
        """A robot receives a safe command of its monitor."""
        self.safe_commands += 1
        now = self._clock()
        for found in self._heard(robot):
            last = found.last_arrival(now)
            if last is not None and now - last < max(JUST_NOW, found.period):
                self._broken(f"{robot} receives a safe command, and {found.name} drives it")

    @property
    def doubly(self) -> Sequence[str]:
        """Robots that hear two instances."""
        return sorted(self._since)

    def look(self, robot: str, monitors: Sequence[Says]) -> None:
        """Compare what a robot's monitors say with what it hears."""
        since = self._since[robot]
        self.doubled += 1
        now, both = self._clock(), " and ".join(sorted(found.name for found in self._heard(robot)))
        for says in monitors:
            lasts = now - max(since, says.unhindered_since) - 2 * max(found.period for found in self._heard(robot))
            known = says.knows & frozenset(self.knew(says.who, now - NOTICED))
            strangers = [found for found in self._heard(robot) if found.uid not in known]
            may_say = {"False", "Unknown"} if strangers or not says.has_gate else {"False"}
            if lasts >= NOTICED and says.health == "Healthy":
                self._broken(f"{says.who} says that {robot} is Healthy, and {both} drive it for {lasts:.1f} s")
            if says.sole not in may_say and min(lasts, now - says.recovered_at) >= NOTICED:
                self._broken(f"{says.who} says SoleDriver={says.sole}, and {both} drive {robot} for {lasts:.1f} s")
            if not all(self._ends(found) for found in strangers):
                continue  # it may be a tool for this monitor, and no request would end it
            for found in self._heard(robot):
                can_end = now - max(since, says.acts_since, self._endable_since(found))
                if can_end >= ENDED:
                    self._broken(f"{both} drive {robot} for {can_end:.1f} s, and {says.who} ends neither")
                    break

    def _endable_since(self, found: Running) -> float:
        """Return since when a cluster can end or fence an instance; infinite if it cannot now."""
        if not self._ends(found):
            self._endable.pop(found.uid, None)
            return math.inf
        return self._endable.setdefault(found.uid, self._clock())
