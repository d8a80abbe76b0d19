"""Statistics of measured values. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, quantiles


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
        cuts = quantiles([*values] * (2 if len(values) == 1 else 1), n=20, method="inclusive")
        return cls(len(values), min(values), fmean(values), cuts[9], cuts[18], max(values))
