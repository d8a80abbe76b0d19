"""What must hold of the instances that a robot hears, and of what its monitor says of that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tests.unit.interleavings.pods import Running

NOTICED = 4.0
"""Seconds after which a monitor has noticed a second driver: one counts after a second, and monitors look once a second."""

JUST_NOW = 0.2
"""Seconds after a sample of an instance in which its robot receives no safe command."""

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
    """Since when (Unix seconds) nothing has kept it from noticing."""
    acts_since: float
    """Since when (Unix seconds) it also reaches the API server."""
    recovered: Mapping[str, float]
    """By id, when recoveries that it recorded as Recovered were verified, in Unix seconds."""


class Drivers:
    """No second driver stays unnoticed."""

    def __init__(
        self,
        clock: Callable[[], float],
        broken: Callable[[str], None],
        heard: Callable[[str], Sequence[Running]],
    ) -> None:
        """``heard`` returns the instances that a robot hears now."""
        self._clock, self._broken, self._heard = clock, broken, heard
        self._since: dict[str, float] = {}
        """By robot, since when there are two."""
        self.doubled = self.safe_commands = 0
        """Seconds for which robots had a second driver, and safe commands that robots received."""

    def routed(self, robot: str) -> None:
        """What a robot hears has changed."""
        if len(self._heard(robot)) > 1:
            self._since.setdefault(robot, self._clock())
        else:
            self._since.pop(robot, None)

    def commanded_safely(self, robot: str) -> None:
        """A robot receives a safe command of its monitor."""
        self.safe_commands += 1
        now = self._clock()
        for found in self._heard(robot):
            last = found.last_arrival(now)
            if last is not None and now - last < JUST_NOW:
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
            lasts = now - max(since, says.unhindered_since)
            if lasts >= NOTICED and says.health == "Healthy":
                self._broken(f"{says.who} says that {robot} is Healthy, and {both} drive it for {lasts:.1f} s")
            if says.sole != "False" and min(lasts, now - says.recovered_at) >= NOTICED:
                self._broken(f"{says.who} says SoleDriver={says.sole}, and {both} drive {robot} for {lasts:.1f} s")
            for id_, verified in says.recovered.items():
                if verified - max(since, says.unhindered_since) >= NOTICED:
                    self._broken(f"{says.who} says that {robot} has recovered by {id_}, and {both} drive it")
            if (acts := now - max(since, says.acts_since)) >= ENDED:
                self._broken(f"{both} drive {robot} for {acts:.1f} s, and {says.who} ends neither")
