"""Estimates the failure rate of robots from a prior assumption and from observations."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from understudy.advice import shortage_risk

SURE = 0.95
"""Confidence that the rate is not above the upper bound, and the same for the lower bound."""


@dataclass(frozen=True)
class Rate:
    """Failures per robot and hour: expected value and 90 % credible interval."""

    expected: float
    low: float
    high: float


def estimate_rate(assumed: float, failures: int, hours: float) -> Rate:
    """Estimate the rate after a number of failures in a number of robot hours.

    The assumption counts as one failure in the time in which one is expected: it dominates without observations and soon loses
    its weight (a gamma distribution, the conjugate prior of the Poisson distribution).
    """
    shape, over = failures + 1, 1 / assumed + hours
    return Rate(shape / over, _quantile(shape, 1 - SURE) / over, _quantile(shape, SURE) / over)


@functools.lru_cache(maxsize=1024)
def _quantile(shape: int, chance: float) -> float:
    """Return a quantile of the gamma distribution with scale 1.

    Solved by bisection: its distribution function equals a Poisson tail probability, which is monotonic.
    """
    low, high = 0.0, 2.0 * shape + 10.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if shortage_risk.window_risk(middle, shape - 1) >= chance else (middle, high)
    return high
