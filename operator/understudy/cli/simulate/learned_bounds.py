"""Measures gaps and rates of a topic in a healthy recording, and proposes bounds for them."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

from understudy.trees.core.rate_window import HIGHEST, Band, Window

QUANTILE = 0.999
"""Quantile of the gaps, by nearest rank: with fewer than a thousand gaps it is the longest one."""

FACTOR = 2.0
"""The proposed gap as a multiple of that quantile."""

MARGIN = 0.2
"""The proposed tolerance beyond the lowest and highest measured rate, as a fraction."""

FEWEST = 20
"""Least number of messages to learn from."""


@dataclass(frozen=True)
class Measures:
    """Measurements of one topic. Times in seconds, rates in Hz."""

    count: int
    rate: float
    """Mean rate from the first message to the last."""
    median: float
    """Median gap."""
    quantile: float
    """The quantile QUANTILE of the gaps."""
    longest: float


@dataclass(frozen=True)
class Bounds:
    """The bounds proposed for a topic."""

    gap: float
    """Seconds."""
    band: Band | None
    """None if the rate varies too much for bounds."""
    window: float
    """Seconds."""
    slowest: float
    """The lowest rate over any window, in Hz."""
    fastest: float


def measured(arrivals: Sequence[float]) -> Measures:
    """Measure a topic with these times of receipt, at least FEWEST."""
    gaps = sorted(later - one for one, later in pairwise(arrivals))
    return Measures(
        count=len(arrivals),
        rate=len(gaps) / (arrivals[-1] - arrivals[0]),
        median=gaps[len(gaps) // 2],
        quantile=gaps[math.ceil(QUANTILE * len(gaps)) - 1],
        longest=gaps[-1],
    )


def proposed(arrivals: Sequence[float], measures: Measures, factor: float, margin: float) -> Bounds:
    """Propose bounds for a topic with these times of receipt, in order."""
    window = math.ceil(max(2.0, 10 / measures.rate) * 10) / 10
    for _ in range(8):
        slowest, fastest = extremes(arrivals, window)
        band = _band(slowest * (1 - margin), fastest * (1 + margin))
        if band is None or (wanted := band.default_window()) <= window:
            break
        window = math.ceil(wanted * 10) / 10  # a longer window varies less, so this ends
    if band is not None and band.shortest_window() > window:
        band = None
    return Bounds(rounded_up(factor * measures.quantile), band, window, slowest, fastest)


def extremes(arrivals: Sequence[float], window: float) -> tuple[float, float]:
    """Return the lowest and highest rate in Hz over any window within the recording; 0 if the recording is shorter than the window."""
    if arrivals[-1] - arrivals[0] < window:
        return 0.0, 0.0
    counter = Window(Band(Fraction(1), None), window)
    left = [counter.leaves(arrival) for arrival in arrivals]
    # A count is highest when a message has arrived, and lowest when one has just left the window.
    most = max(place + 1 - bisect_right(left, moment) for place, moment in enumerate(arrivals))
    judged = [moment for moment in left if moment <= arrivals[-1]]
    least = min(bisect_right(arrivals, moment) - bisect_right(left, moment) for moment in judged)
    return least / window, most / window


def _band(low: float, high: float) -> Band | None:
    """Return the band between two rates, rounded to readable figures; None if there is no useful one."""
    low, high = _figures(low, math.floor), _figures(high, math.ceil)
    if low <= 0 or high > HIGHEST or high > 10 * low:
        return None
    return Band.parse(f"{low:g} to {high:g} Hz")


def rounded_up(seconds: float) -> float:
    """Round a time up to two figures, at least a millisecond."""
    return max(0.001, round(_figures(round(seconds, 4), math.ceil), 3))


def _figures(value: float, way: Callable[[float], int]) -> float:
    """Round a value to two figures in one direction."""
    if value <= 0:
        return 0.0
    unit = Fraction(10) ** (math.floor(math.log10(value)) - 1)
    # A value with two figures stays the same despite float errors.
    return float(way(round(float(Fraction(value) / unit), 6)) * unit)
