"""The demand of a fleet for fallbacks."""

from __future__ import annotations

from dataclasses import dataclass

_HOUR = 3600.0


@dataclass(frozen=True)
class Demand:
    """Robots with independent failures at the same rate: the failures of the fleet are a Poisson process.

    This holds while most robots work, and not if one cause makes many robots fail at once.
    """

    robots: int
    """Number of robots that share the fallbacks."""
    failures_per_robot_hour: float
    refill: float
    """Seconds from a failure until the used fallback is replaced."""

    @property
    def rate(self) -> float:
        """Failures of the fleet per second."""
        return self.robots * self.failures_per_robot_hour / _HOUR

    @property
    def offered(self) -> float:
        """Mean number of fallbacks in use if there were always one left (erlangs)."""
        return self.rate * self.refill
