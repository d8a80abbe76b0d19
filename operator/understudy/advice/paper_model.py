"""The paper's estimate for the number of fallbacks (section IV.D, scaling considerations), with which its figures are reproduced.

It divides an interval into steps of one second, takes the failures that exceed the fallbacks, and counts the distributions of
these over the steps (a binomial coefficient) in which all are within one window. So 1000 failures per hour, 4 fallbacks and a
window of 6 s in an interval of 30 s result in 3276 of 278256: 1.2 %.

It neglects three effects: distributions of indistinguishable failures are not equally likely if robots fail independently; all
failures, not only the excess ones, must be close together for a shortage; and an interval may have more failures than average.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

INTERVAL = 30
"""Seconds of the paper's interval."""


@dataclass(frozen=True)
class PaperEstimate:
    """The steps of the estimate."""

    expected: float
    """Failures of the fleet in the interval."""
    remaining: int
    """Failures that exceed the fallbacks, rounded up."""
    together: int
    """Number of distributions with those within one window."""
    ways: int
    """Number of distributions over the interval."""

    @property
    def chance(self) -> float:
        """The paper's probability of a longer downtime."""
        return self.together / self.ways


def estimate(rate: float, window: float, fallbacks: int, interval: int = INTERVAL) -> PaperEstimate:
    """Compute the estimate for ``rate`` failures per second; times in seconds, the window rounded up to whole seconds."""
    expected = rate * interval
    remaining = max(0, math.ceil(expected - fallbacks))
    steps = min(interval, max(1, math.ceil(window)))
    if not remaining:
        return PaperEstimate(expected, 0, 1, 1)
    # Sum over the step of the first failure: the others are within the window that begins there.
    together = sum(_spread(remaining - 1, min(steps, interval - first)) for first in range(interval))
    return PaperEstimate(expected, remaining, together, _spread(remaining, interval))


def _spread(failures: int, steps: int) -> int:
    """Return the number of distributions of indistinguishable failures over the steps."""
    return math.comb(steps + failures - 1, failures)
