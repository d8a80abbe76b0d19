"""What a fleet asks of its fallbacks."""

from __future__ import annotations

from dataclasses import dataclass

_HOUR = 3600.0


@dataclass(frozen=True)
class Demand:
    """Robots that fail independently of each other, each at the same rate: failures of the fleet are a Poisson process.

    That holds while far fewer are down than there are, and not where one cause makes many fail at once.
    """

    robots: int
    """How many share the fallbacks."""
    failures_per_robot_hour: float
    refill: float
    """Seconds from a failure until another fallback waits in place of the one that it took."""

    @property
    def rate(self) -> float:
        """Failures of the fleet per second."""
        return self.robots * self.failures_per_robot_hour / _HOUR

    @property
    def offered(self) -> float:
        """Fallbacks that would be away on average if there were always one left (erlangs)."""
        return self.rate * self.refill
