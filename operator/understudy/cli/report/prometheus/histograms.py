"""Histograms as Prometheus stores them: cumulative counts by upper bound. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Bucket:
    """The times between two bounds, in seconds."""

    above: float
    most: float
    """Infinite for the last bucket."""
    count: float


@dataclass(frozen=True)
class Histogram:
    """A histogram of at least one time."""

    bounds: Sequence[float]
    """The upper bounds in seconds, rising; the last one is infinite."""
    counts: Sequence[float]
    """Cumulative counts by bound."""
    total: float
    """Sum of all times in seconds."""

    @classmethod
    def of(cls, below: Mapping[float, float], total: float) -> Histogram | None:
        """Build a histogram from cumulative counts by bound; None if there are no times."""
        bounds = sorted(below)
        counts: list[float] = []
        for bound in bounds:  # the counts may be inconsistent after a process ended between two scrapes
            counts.append(max(below[bound], counts[-1] if counts else 0.0))
        if not bounds or not math.isinf(bounds[-1]) or round(counts[-1]) < 1:
            return None
        return cls(bounds, counts, total)

    @property
    def count(self) -> int:
        """The number of times."""
        return round(self.counts[-1])

    @property
    def mean(self) -> float:
        """The mean in seconds, which is exact, unlike quantiles."""
        return self.total / self.counts[-1]

    def quantile(self, fraction: float) -> float:
        """Return a quantile, interpolated linearly between the surrounding bounds, as ``histogram_quantile`` does.

        Returns the last finite bound if the quantile lies beyond it.
        """
        rank, found = fraction * self.counts[-1], list(self.buckets())
        below = 0.0
        for bucket in found:
            if below + bucket.count >= rank and bucket.count:
                if math.isinf(bucket.most):
                    return bucket.above
                return bucket.above + (bucket.most - bucket.above) * (rank - below) / bucket.count
            below += bucket.count
        return found[-1].above

    def is_beyond(self, fraction: float) -> bool:
        """Return whether a quantile lies beyond the last finite bound."""
        return len(self.counts) > 1 and fraction * self.counts[-1] > self.counts[-2]

    def buckets(self) -> Iterator[Bucket]:
        """Yield the buckets."""
        above, before = 0.0, 0.0
        for bound, count in zip(self.bounds, self.counts, strict=True):
            yield Bucket(above, bound, count - before)
            above, before = bound, count
