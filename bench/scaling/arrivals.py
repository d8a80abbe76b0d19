"""Who fails when: open-loop, so that what is slow to recover doesn't put off the next failure."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def poisson(rate: float, seconds: float, source: random.Random) -> list[float]:
    """The times, in seconds from the start and in order, of events that come independently of each other at a rate per second."""
    found, at = [], source.expovariate(rate)
    while at < seconds:
        found.append(at)
        at += source.expovariate(rate)
    return found


def spread(items: Sequence[T], count: int, source: random.Random) -> list[T]:
    """So many of them in a random order; each comes again only after all others."""
    found: list[T] = []
    while len(found) < count:
        found += source.sample(items, min(len(items), count - len(found)))
    return found
