"""The chance that failures find too few fallbacks, by three measures; ``offered`` is in erlangs (:class:`Demand`).

Erlang's formulas, by their usual recursion (A. K. Erlang, 1917; for instance ITU-T E.501), which neither overflows nor
cancels however many fallbacks there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

MOST = 1_000_000
"""Most fallbacks that are thought about."""


def crowded(offered: float, fallbacks: int) -> float:
    """The chance that more failures than there are fallbacks fall into a window as long as the refill takes."""
    if offered == 0:
        return 0.0
    likeliest = fallbacks + 1
    if likeliest <= offered:  # then the head is the smaller part
        return max(0.0, 1.0 - _poisson_sum(offered, range(fallbacks, -1, -1)))
    return _poisson_sum(offered, range(likeliest, MOST + 2))


def lost(offered: float, fallbacks: int) -> float:
    """The chance that a failure finds no fallback, where it then goes without one (Erlang B).

    Holds for any distribution of the refill's time around its mean.
    """
    blocked = 1.0
    for count in range(1, fallbacks + 1):
        blocked = offered * blocked / (count + offered * blocked)
    return blocked if offered > 0 else 0.0


def waits(offered: float, fallbacks: int) -> float:
    """The chance that a failure has to wait, where it then waits for the next fallback (Erlang C, exponential refill)."""
    if offered >= fallbacks:
        return 1.0 if offered > 0 else 0.0
    blocked = lost(offered, fallbacks)
    return blocked / (1.0 - offered / fallbacks * (1.0 - blocked))


def wait(offered: float, fallbacks: int, refill: float) -> float:
    """Mean wait of all failures in seconds, those that don't wait included; infinite where they come faster than refills.

    For a refill of exponential length; one that always takes the same time makes for about half of it.
    """
    if offered >= fallbacks:
        return math.inf if offered > 0 else 0.0
    return waits(offered, fallbacks) * refill / (fallbacks - offered)


MEASURES: Mapping[str, Callable[[float, int], float]] = {"loss": lost, "waiting": waits, "window": crowded}
"""Each falls as fallbacks are added."""


def enough(measure: str, offered: float, risk: float, *, most: int = MOST) -> int:
    """The fewest fallbacks whose risk, by one of the :data:`MEASURES`, is at most so high.

    Raises ValueError where not even ``most`` are enough, and for a risk outside of 0 to 1.
    """
    if not 0 < risk < 1:
        raise ValueError(f"the risk must be above 0 and below 1, found {risk:g}")
    function = MEASURES[measure]
    high = 1
    while function(offered, high) > risk:
        high *= 2
        if high > most:
            raise ValueError(f"not even {most} fallbacks are enough for {offered:g} that are away on average")
    low = high // 2  # not enough, or none
    if function(offered, low) <= risk:
        return low
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if function(offered, middle) <= risk else (middle, high)
    return high


def _poisson_sum(mean: float, counts: range) -> float:
    """The sum of the Poisson probabilities of counts that get less likely one by one, as far as that matters."""
    total = 0.0
    for count in counts:
        term = math.exp(count * math.log(mean) - mean - math.lgamma(count + 1))
        total += term
        if term < total * 1e-17:
            break
    return total
