"""Statistics of measured values. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean


def quantile(values: Sequence[float], fraction: float) -> float:
    """Return a quantile, interpolated linearly between the two nearest ranks."""
    ordered = sorted(values)
    place = fraction * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


@dataclass(frozen=True)
class Spread:
    """Statistics of at least one value."""

    count: int
    least: float
    mean: float
    p50: float
    p95: float
    greatest: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Compute the statistics of these values."""
        return cls(len(values), min(values), fmean(values), quantile(values, 0.5), quantile(values, 0.95), max(values))
