"""The same by trial: failures are drawn, fallbacks are taken and come back, and what becomes of each failure is counted."""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from random import Random

from understudy.advice.demand import Demand

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
        window=_share(
            [index for index, found in _spells(times, demand.refill) if len(found) > fallbacks],
            _whole(times, demand.refill),
        ),
        loss=_estimate(lost(times, fallbacks, lambda: demand.refill)),
        waiting=_estimate([float(wait > 0) for wait in waited]),
        wait=_estimate(waited),
        interval=_share(
            [index for index, found in _spells(times, interval) if _is_crowded(found, demand.refill, fallbacks)],
            _whole(times, interval),
        ),
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


def _whole(times: Sequence[float], length: float) -> int:
    """Spells of a length that the time up to the last failure holds, at least one."""
    return max(1, int(times[-1] / length))


def _spells(times: Sequence[float], length: float) -> Iterator[tuple[int, Sequence[float]]]:
    """The failures in each of the whole spells with any, by its number. Where failures are rare or spells short, nearly all have none."""
    number = _whole(times, length)
    for index, found in groupby(times, lambda time: int(time / length)):
        if index < number:
            yield index, list(found)


def _is_crowded(failures: Sequence[float], window: float, fallbacks: int) -> bool:
    """Whether any window among these has more of them than there are fallbacks."""
    return any(later - one < window for one, later in zip(failures, failures[fallbacks:], strict=False))


def _share(found: Sequence[int], number: int) -> Estimate:
    """How many of so many spells are those of these numbers (in order), which are all that needs to be known: see :func:`_estimate`."""
    size = number / BATCHES
    if size < 1:
        return Estimate(len(found) / number, math.inf)
    edges = [round(place * size) for place in range(BATCHES + 1)]
    counts = [bisect_left(found, later) - bisect_left(found, one) for one, later in pairwise(edges)]
    means = [count / (later - one) for count, (one, later) in zip(counts, pairwise(edges), strict=True)]
    return Estimate(len(found) / number, _within(means, len(found) / number))


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
    return Estimate(mean, _within(means, mean))


def _within(means: Sequence[float], mean: float) -> float:
    """Half the width of the interval of confidence, by the means of the batches and that of all."""
    spread = math.sqrt(sum((each - mean) ** 2 for each in means) / (BATCHES - 1))
    return _SURE * spread / math.sqrt(BATCHES)
