"""Adapts the size of a pool to the failures: it grows at once, and shrinks slowly, by one, if the smaller size surely suffices.

It grows by the expected rate and shrinks by the upper bound of the rate. This hysteresis prevents the size from alternating between two
values.
"""

from __future__ import annotations

from dataclasses import dataclass

from understudy.advice import shortage_risk
from understudy.advice.demand import Demand
from understudy.advice.failure_rate import Rate

REST = 600.0
"""Least seconds from a change of the size to the next decrease."""

COUNTED = 1024
"""Largest size that is calculated."""


@dataclass(frozen=True)
class SizingTarget:
    """The requirements of a pool. Times in seconds."""

    risk: float
    measure: str
    """One of :data:`understudy.advice.shortage_risk.MEASURES`."""
    refill: float
    least: int
    most: int
    kept_back: int = 0
    """Fallbacks reserved for some robots, in addition to the calculated ones."""


@dataclass(frozen=True)
class CurrentSize:
    """The current size of a pool, and since when."""

    size: int
    since: float


@dataclass(frozen=True)
class Decision:
    """The new size of a pool, and the reasons."""

    size: int
    since: float
    needed: int
    """Sufficient for the risk at the expected rate, regardless of limits."""
    safe: int
    """Sufficient at the upper bound of the rate."""

    @property
    def shrinks(self) -> bool:
        """Whether the size is larger than surely needed."""
        return self.safe < self.size


def decide_size(aim: SizingTarget, robots: int, rate: Rate, before: CurrentSize | None, now: float) -> Decision:
    """Decide on the size for a number of robots and their failure rate."""
    needed, safe = (_enough(aim, robots, one) for one in (rate.expected, rate.high))
    size = needed if before is None else before.size
    if needed > size:
        size = needed
    elif before is not None and max(safe, aim.least) < size and now - before.since >= REST:
        size -= 1
    size = min(aim.most, max(aim.least, size))
    return Decision(size, before.since if before is not None and before.size == size else now, needed, safe)


def _enough(aim: SizingTarget, robots: int, rate: float) -> int:
    """Return the fewest fallbacks for the risk."""
    offered = Demand(robots, rate, aim.refill).offered
    if offered == 0:
        return aim.kept_back
    try:
        return shortage_risk.fewest_fallbacks(aim.measure, offered, aim.risk, most=COUNTED) + aim.kept_back
    except ValueError:
        return COUNTED
