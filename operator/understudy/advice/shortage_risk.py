"""Probabilities of a shortage of fallbacks, by three measures; ``offered`` is the load in erlangs (:class:`Demand`).

Erlang's formulas by the usual recursion (A. K. Erlang, 1917; ITU-T E.501), which is numerically stable for any number of
fallbacks.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping

MOST = 1_000_000
"""Largest number of fallbacks that is calculated."""


def window_risk(offered: float, fallbacks: int) -> float:
    """Return the probability of more failures than fallbacks within one refill time."""
    if offered == 0:
        return 0.0
    likeliest = fallbacks + 1
    if likeliest <= offered:  # the sum over the head has fewer terms
        return max(0.0, 1.0 - _poisson_sum(offered, range(fallbacks, -1, -1)))
    return _poisson_sum(offered, range(likeliest, MOST + 2))


def loss_risk(offered: float, fallbacks: int) -> float:
    """Return the probability that a failure finds no fallback, if failures do not wait (Erlang B).

    It holds for any distribution of the refill time.
    """
    blocked = 1.0
    for count in range(1, fallbacks + 1):
        blocked = offered * blocked / (count + offered * blocked)
    return blocked if offered > 0 else 0.0


def waiting_risk(offered: float, fallbacks: int) -> float:
    """Return the probability that a failure has to wait, if failures wait (Erlang C, exponential refill time)."""
    if offered >= fallbacks:
        return 1.0 if offered > 0 else 0.0
    blocked = loss_risk(offered, fallbacks)
    return blocked / (1.0 - offered / fallbacks * (1.0 - blocked))


def mean_wait(offered: float, fallbacks: int, refill: float) -> float:
    """Return the mean wait of all failures in seconds, including those that do not wait; infinite if failures are faster than refills.

    It assumes an exponential refill time; a constant one leads to about half of it.
    """
    if offered >= fallbacks:
        return math.inf if offered > 0 else 0.0
    return waiting_risk(offered, fallbacks) * refill / (fallbacks - offered)


MEASURES: Mapping[str, Callable[[float, int], float]] = {
    "loss": loss_risk,
    "waiting": waiting_risk,
    "window": window_risk,
}
"""Each decreases with the number of fallbacks."""


def fewest_fallbacks(measure: str, offered: float, risk: float, *, most: int = MOST) -> int:
    """Return the fewest fallbacks with at most this risk, by one of the :data:`MEASURES`.

    Raises ValueError if ``most`` are not enough, or for a risk outside 0 to 1.
    """
    if not 0 < risk < 1:
        raise ValueError(f"the risk must be above 0 and below 1, found {risk:g}")
    function = MEASURES[measure]
    high = 1
    while function(offered, high) > risk:
        high *= 2
        if high > most:
            raise ValueError(f"a pool of {most} is not enough: on average, {offered:g} of its pods are in use")
    return bisect_left(range(high), True, key=lambda count: function(offered, count) <= risk)


def _poisson_sum(mean: float, counts: range) -> float:
    """Sum Poisson probabilities of counts in order of decreasing probability, until the rest is negligible."""
    total = 0.0
    for count in counts:
        term = math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))
        total += term
        if term < total * 1e-17:
            break
    return total
