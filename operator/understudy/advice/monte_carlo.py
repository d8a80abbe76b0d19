"""Estimates the risks by simulation: random failures use fallbacks, which are refilled, and the outcome of each is counted."""

from __future__ import annotations

import heapq
import math
import statistics
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from random import Random

from understudy.advice.demand import Demand

BATCHES = 20
"""Number of batches of failures, for confidence intervals."""

_SURE = 2.093
"""Student's t for 95 % with one less than :data:`BATCHES` degrees of freedom."""


@dataclass(frozen=True)
class Estimate:
    """A mean, and half the width of its 95 % confidence interval."""

    mean: float
    within: float


@dataclass(frozen=True)
class Trials:
    """The results of a simulation with a constant refill time."""

    failures: int
    window: Estimate
    """Share of windows of one refill time with more failures than fallbacks."""
    loss: Estimate
    """Share of failures that find no fallback, if failures do not wait."""
    waiting: Estimate
    """Share of failures that have to wait, if failures wait."""
    wait: Estimate
    """Mean wait of all failures in seconds."""
    interval: Estimate
    """Share of intervals (of the paper's length) with a window that has more failures than fallbacks."""


def simulate(demand: Demand, fallbacks: int, interval: float, *, failures: int = 200_000, seed: int = 1) -> Trials:
    """Run the simulation. The rate must be above 0."""
    times = list(_arrivals(demand.rate, failures, Random(seed)))
    waited = wait_times(times, fallbacks, lambda: demand.refill)
    return Trials(
        failures=failures,
        window=_share(
            [index for index, found in _spells(times, demand.refill) if len(found) > fallbacks],
            _whole(times, demand.refill),
        ),
        loss=_estimate(losses(times, fallbacks, lambda: demand.refill)),
        waiting=_estimate([float(wait > 0) for wait in waited]),
        wait=_estimate(waited),
        interval=_share(
            [index for index, found in _spells(times, interval) if _is_crowded(found, demand.refill, fallbacks)],
            _whole(times, interval),
        ),
    )


def losses(times: Sequence[float], fallbacks: int, refill: Callable[[], float]) -> list[float]:
    """Return 1 for each failure that finds no fallback and does not wait, else 0."""
    away: list[float] = []
    found = []
    for time in times:
        while away and away[0] <= time:
            heapq.heappop(away)
        without = len(away) >= fallbacks
        if not without:
            heapq.heappush(away, time + refill())
        found.append(float(without))
    return found


def wait_times(times: Sequence[float], fallbacks: int, refill: Callable[[], float]) -> list[float]:
    """Return how long each failure waits for a fallback, first come first served."""
    if fallbacks == 0:
        return [math.inf] * len(times)
    back = [0.0] * fallbacks
    found = []
    for time in times:
        start = max(time, back[0])
        heapq.heapreplace(back, start + refill())
        found.append(start - time)
    return found


def _arrivals(rate: float, failures: int, draw: Random) -> Iterator[float]:
    now = 0.0
    for _ in range(failures):
        now += draw.expovariate(rate)
        yield now


def _whole(times: Sequence[float], length: float) -> int:
    """Return the number of whole intervals of a length until the last failure, at least one."""
    return max(1, int(times[-1] / length))


def _spells(times: Sequence[float], length: float) -> Iterator[tuple[int, Sequence[float]]]:
    """Yield index and failures of the intervals with any. With rare failures or short intervals, most have none."""
    number = _whole(times, length)
    for index, found in groupby(times, lambda time: int(time / length)):
        if index < number:
            yield index, list(found)


def _is_crowded(failures: Sequence[float], window: float, fallbacks: int) -> bool:
    """Return whether any window has more failures than fallbacks."""
    return any(later - one < window for one, later in zip(failures, failures[fallbacks:], strict=False))


def _share(found: Sequence[int], number: int) -> Estimate:
    """Estimate the share of ``number`` intervals whose indices (in order) are in ``found``; see :func:`_estimate`."""

    def mean(one: int, later: int) -> float:
        return (bisect_left(found, later) - bisect_left(found, one)) / (later - one)

    return _by_batches(number, len(found) / number, mean)


def _estimate(values: Sequence[float]) -> Estimate:
    """Estimate by the means of batches in order, because neighbouring values are correlated."""
    whole = math.fsum(values) / len(values)
    if not math.isfinite(whole):
        return Estimate(whole, 0.0)
    return _by_batches(len(values), whole, lambda one, later: math.fsum(values[one:later]) / (later - one))


def _by_batches(number: int, whole: float, mean: Callable[[int, int], float]) -> Estimate:
    """Estimate a mean from those of batches; ``mean`` is that of a range of the ``number`` values."""
    size = number / BATCHES
    if size < 1:
        return Estimate(whole, math.inf)
    edges = [round(place * size) for place in range(BATCHES + 1)]
    means = [mean(one, later) for one, later in pairwise(edges)]
    return Estimate(whole, _SURE * statistics.stdev(means, whole) / math.sqrt(BATCHES))
