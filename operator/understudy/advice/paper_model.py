"""The paper's own argument for a few fallbacks (section IV.D, scaling considerations), as its figures follow from it.

It divides an interval into steps of a second, takes the failures that the fallbacks don't cover, and counts in how many
of the ways to spread these over the steps, by how many fall on each (its binomial coefficient), all are within one
window. So 1000 failures an hour, 4 fallbacks and a window of 6 s in an interval of 30 s make 3276 of 278256: 1.2 %.

What it leaves out, each by a factor of its own: ways to spread indistinguishable failures aren't equally likely where
robots fail independently of each other; all failures, not only those left over, need to be close together for a shortage;
and an interval may hold more than their average.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

INTERVAL = 30
"""Seconds of the paper's interval."""


@dataclass(frozen=True)
class Argument:
    """Its steps, with the figures that it comes to."""

    expected: float
    """Failures of the fleet in the interval."""
    remaining: int
    """How many of them the fallbacks don't cover, rounded up."""
    together: int
    """Ways to have those within one window."""
    ways: int
    """Ways to spread them over the interval."""

    @property
    def chance(self) -> float:
        """What the paper takes for the probability of a longer down-time."""
        return self.together / self.ways


def argued(rate: float, window: float, fallbacks: int, interval: int = INTERVAL) -> Argument:
    """The argument for a fleet with ``rate`` failures a second; times in seconds, the window in whole ones (rounded up)."""
    expected = rate * interval
    remaining = max(0, math.ceil(expected - fallbacks))
    steps = min(interval, max(1, math.ceil(window)))
    if not remaining:
        return Argument(expected, 0, 1, 1)
    # Each way by its first failure: the others spread over the window that begins with that one's step.
    together = sum(_spread(remaining - 1, min(steps, interval - first)) for first in range(interval))
    return Argument(expected, remaining, together, _spread(remaining, interval))


def _spread(failures: int, steps: int) -> int:
    """Ways to spread indistinguishable failures over so many steps."""
    return math.comb(steps + failures - 1, failures)
