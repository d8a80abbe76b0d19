"""What a healthy recording says of a topic's gaps and rates, and the bounds that are proposed for them."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

from understudy.trees.core.rate_window import HIGHEST, Band, Window

QUANTILE = 0.999
"""Of the gaps, by nearest rank: with less than a thousand gaps it is the longest one."""

FACTOR = 2.0
"""How many times that quantile a gap may last."""

MARGIN = 0.2
"""By which part a rate may be further out than the least and the greatest that were measured."""

FEWEST = 20
"""Messages from which something can be learnt at all."""


@dataclass(frozen=True)
class Measures:
    """Of one topic. Times in seconds, rates in Hz."""

    count: int
    rate: float
    """From the first message to the last."""
    median: float
    """Of the gaps."""
    quantile: float
    """The QUANTILE of the gaps."""
    longest: float


@dataclass(frozen=True)
class Bounds:
    """What is proposed for a topic."""

    gap: float
    """Seconds."""
    band: Band | None
    """None where the rate varies too much to be bounded."""
    window: float
    """Seconds."""
    slowest: float
    """The least rate over any window, in Hz."""
    fastest: float


def measured(arrivals: Sequence[float]) -> Measures:
    """The measures of a topic that was received at these times, at least FEWEST."""
    gaps = sorted(later - one for one, later in pairwise(arrivals))
    return Measures(
        count=len(arrivals),
        rate=len(gaps) / (arrivals[-1] - arrivals[0]),
        median=gaps[len(gaps) // 2],
        quantile=gaps[math.ceil(QUANTILE * len(gaps)) - 1],
        longest=gaps[-1],
    )


def proposed(arrivals: Sequence[float], measures: Measures, factor: float, margin: float) -> Bounds:
    """The bounds for a topic with these arrivals, in order of time."""
    window = math.ceil(max(2.0, 10 / measures.rate) * 10) / 10
    for _ in range(8):
        slowest, fastest = extremes(arrivals, window)
        band = _band(slowest * (1 - margin), fastest * (1 + margin))
        if band is None or (wanted := band.default_window()) <= window:
            break
        window = math.ceil(wanted * 10) / 10  # a longer one varies less, so this comes to an end
    if band is not None and band.shortest_window() > window:
        band = None
    return Bounds(rounded_up(factor * measures.quantile), band, window, slowest, fastest)


def extremes(arrivals: Sequence[float], window: float) -> tuple[float, float]:
    """The least and the greatest rate in Hz over any window within the recorded time; 0 where that is shorter than one."""
    if arrivals[-1] - arrivals[0] < window:
        return 0.0, 0.0
    counter = Window(Band(Fraction(1), None), window)
    left = [counter.leaves(arrival) for arrival in arrivals]
    # A count is greatest when a message has come, and least when one has just left.
    most = max(place + 1 - bisect_right(left, moment) for place, moment in enumerate(arrivals))
    judged = [moment for moment in left if moment <= arrivals[-1]]
    least = min(bisect_right(arrivals, moment) - bisect_right(left, moment) for moment in judged)
    return least / window, most / window


def _band(low: float, high: float) -> Band | None:
    """The band between two rates, in figures that people write; None where there is no sensible one."""
    low, high = _figures(low, math.floor), _figures(high, math.ceil)
    if low <= 0 or high > HIGHEST or high > 10 * low:
        return None
    return Band.parse(f"{low:g} to {high:g} Hz")


def rounded_up(seconds: float) -> float:
    """A time in two figures, not below a millisecond."""
    return max(0.001, round(_figures(round(seconds, 4), math.ceil), 3))


def _figures(value: float, way: Callable[[float], int]) -> float:
    """A value in two figures, rounded one way."""
    if value <= 0:
        return 0.0
    unit = Fraction(10) ** (math.floor(math.log10(value)) - 1)
    # What is a figure already stays it, whatever the last digits of a float are.
    return float(way(round(float(Fraction(value) / unit), 6)) * unit)
