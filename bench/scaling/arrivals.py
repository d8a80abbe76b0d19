"""Open-loop times of failures: a slow recovery does not delay the next failure."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def poisson(rate: float, seconds: float, source: random.Random) -> list[float]:
    """Return the times of independent events at a rate per second, in seconds from the start and in order."""
    found, at = [], source.expovariate(rate)
    while at < seconds:
        found.append(at)
        at += source.expovariate(rate)
    return found


def spread(items: Sequence[T], count: int, source: random.Random) -> list[T]:
    """Return ``count`` items in random order. An item is repeated only after all others."""
    found: list[T] = []
    while len(found) < count:
        found += source.sample(items, min(len(items), count - len(found)))
    return found
