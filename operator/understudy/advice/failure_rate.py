"""How often robots fail, as far as that is known: what is assumed at first, and what was seen since."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from understudy.advice import shortage_risk

SURE = 0.95
"""How sure it is that the rate is no higher than the upper limit, and as sure that it is no lower than the lower one."""


@dataclass(frozen=True)
class Rate:
    """Failures per robot and hour: what is to be expected, and between which limits it is (90 %)."""

    expected: float
    low: float
    high: float


def estimated(assumed: float, failures: int, hours: float) -> Rate:
    """The rate after so many failures in so many robot hours.

    What is assumed counts as one failure, in the time in which one would be expected: it decides while nothing was seen, and
    soon doesn't matter any more (a gamma distribution, the conjugate prior of Poisson's).
    """
    shape, over = failures + 1, 1 / assumed + hours
    return Rate(shape / over, _quantile(shape, 1 - SURE) / over, _quantile(shape, SURE) / over)


@functools.lru_cache(maxsize=1024)
def _quantile(shape: int, chance: float) -> float:
    """Below which a gamma distributed number of scale 1 is with such a chance.

    As often as so many events or more happen where that many are expected (Poisson), which only grows with it.
    """
    low, high = 0.0, 2.0 * shape + 10.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if shortage_risk.crowded(middle, shape - 1) >= chance else (middle, high)
    return high
