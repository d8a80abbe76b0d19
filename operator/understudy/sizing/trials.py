"""The same by trial: failures are drawn, fallbacks are taken and come back, and what becomes of each failure is counted."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from random import Random

from understudy.sizing.demands import Demand

BATCHES = 20
"""Parts that the failures are divided into, to tell how sure a mean is."""

_SURE = 2.093
"""Student's t for 95 % with one less than :data:`BATCHES` degrees of freedom."""


@dataclass(frozen=True)
class Estimate:
    """A mean and half the width of its interval of confidence of 95 %."""

    mean: float
    within: float


@dataclass(frozen=True)
class Trials:
    """What came of it, with a refill that always takes the same time."""

    failures: int
    window: Estimate
    """Windows as long as a refill with more failures than there are fallbacks."""
    loss: Estimate
    """Failures that found no fallback, where they then go without one."""
    waiting: Estimate
    """Failures that had to wait, where they then wait for one."""
    wait: Estimate
    """Seconds that all failures waited, on average."""
    interval: Estimate
    """Intervals (of the paper's length) that hold a window with more failures than there are fallbacks."""


def tried(demand: Demand, fallbacks: int, interval: float, *, failures: int = 200_000, seed: int = 1) -> Trials:
    """Try it. The rate has to be above 0."""
    times = list(_arrivals(demand.rate, failures, Random(seed)))
    waited = waits(times, fallbacks, lambda: demand.refill)
    return Trials(
        failures=failures,
        window=_estimate([float(count > fallbacks) for count in _counts(times, demand.refill)]),
        loss=_estimate(lost(times, fallbacks, lambda: demand.refill)),
        waiting=_estimate([float(wait > 0) for wait in waited]),
        wait=_estimate(waited),
        interval=_estimate(list(_crowded(times, interval, demand.refill, fallbacks))),
    )


def lost(times: Sequence[float], fallbacks: int, refill: Callable[[], float]) -> list[float]:
    """Of failures at these times, for each 1 where it found no fallback and goes without, else 0."""
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


def waits(times: Sequence[float], fallbacks: int, refill: Callable[[], float]) -> list[float]:
    """Of failures at these times, how long each waits for a fallback, first come first served."""
    if fallbacks == 0:
        return [math.inf] * len(times)
    back = [0.0] * fallbacks
    found = []
    for time in times:
        begun = max(time, back[0])
        heapq.heapreplace(back, begun + refill())
        found.append(begun - time)
    return found


def _arrivals(rate: float, failures: int, draw: Random) -> Iterator[float]:
    now = 0.0
    for _ in range(failures):
        now += draw.expovariate(rate)
        yield now


def _counts(times: Sequence[float], window: float) -> list[int]:
    """Failures in each of the windows that the time is divided into."""
    counts = [0] * max(1, int(times[-1] / window))
    for time in times:
        if (index := int(time / window)) < len(counts):
            counts[index] += 1
    return counts


def _crowded(times: Sequence[float], interval: float, window: float, fallbacks: int) -> Iterator[float]:
    """For each interval, 1 where any window in it has more failures than there are fallbacks."""
    begin = 0
    for number in range(max(1, int(times[-1] / interval))):
        end = begin
        while end < len(times) and times[end] < (number + 1) * interval:
            end += 1
        inner = times[begin:end]
        yield float(any(later - one < window for one, later in zip(inner, inner[fallbacks:], strict=False)))
        begin = end


def _estimate(values: Sequence[float]) -> Estimate:
    """By the means of batches in their order, since neighbours depend on each other."""
    mean = math.fsum(values) / len(values)
    if not math.isfinite(mean):
        return Estimate(mean, 0.0)
    size = len(values) / BATCHES
    if size < 1:
        return Estimate(mean, math.inf)
    edges = [round(number * size) for number in range(BATCHES + 1)]
    means = [math.fsum(values[one:later]) / (later - one) for one, later in pairwise(edges)]
    spread = math.sqrt(sum((each - mean) ** 2 for each in means) / (BATCHES - 1))
    return Estimate(mean, _SURE * spread / math.sqrt(BATCHES))
