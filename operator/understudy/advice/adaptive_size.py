"""Has the size of a pool follow the failures: it grows at once, and shrinks late, one by one, where that is sure to be enough.

The two don't meet, so a size at the border of two isn't left again and again: it grows by the rate that is to be expected, and
shrinks by the highest that it may well be.
"""

from __future__ import annotations

from dataclasses import dataclass

from understudy.advice import shortage_risk
from understudy.advice.demand import Demand
from understudy.advice.failure_rate import Rate

REST = 600.0
"""Seconds from one change of the size to the next smaller one."""

COUNTED = 1024
"""More fallbacks than these aren't told apart."""


@dataclass(frozen=True)
class Aim:
    """What is asked of a pool. Times in seconds."""

    risk: float
    measure: str
    """One of :data:`understudy.advice.shortage_risk.MEASURES`."""
    refill: float
    least: int
    most: int
    kept_back: int = 0
    """Fallbacks that not every robot may take: they come on top."""


@dataclass(frozen=True)
class Held:
    """The size that a pool has, and since when."""

    size: int
    since: float


@dataclass(frozen=True)
class Decision:
    """The size that it is to have, and why."""

    size: int
    since: float
    needed: int
    """Enough for the risk at the rate that is to be expected, whatever the limits."""
    safe: int
    """Enough for it even at the highest rate that it may well be."""

    @property
    def shrinks(self) -> bool:
        """Whether it is more than surely needed."""
        return self.safe < self.size


def decided(aim: Aim, robots: int, rate: Rate, before: Held | None, now: float) -> Decision:
    """The size for so many robots that fail so often."""
    needed, safe = (_enough(aim, robots, one) for one in (rate.expected, rate.high))
    size = needed if before is None else before.size
    if needed > size:
        size = needed
    elif before is not None and max(safe, aim.least) < size and now - before.since >= REST:
        size -= 1
    size = min(aim.most, max(aim.least, size))
    return Decision(size, before.since if before is not None and before.size == size else now, needed, safe)


def _enough(aim: Aim, robots: int, rate: float) -> int:
    """The fewest fallbacks for the risk."""
    offered = Demand(robots, rate, aim.refill).offered
    if offered == 0:
        return aim.kept_back
    try:
        return shortage_risk.enough(aim.measure, offered, aim.risk, most=COUNTED) + aim.kept_back
    except ValueError:
        return COUNTED
