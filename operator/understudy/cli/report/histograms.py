"""Times of which only how many were how long at most is known, as Prometheus' histograms have them; pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Bucket:
    """The times between two bounds, in seconds."""

    above: float
    most: float
    """Infinite for those beyond the last bound."""
    count: float


@dataclass(frozen=True)
class Histogram:
    """How many times were how long, of which there is at least one."""

    bounds: Sequence[float]
    """The upper bounds in seconds, rising; the last one is infinite."""
    counts: Sequence[float]
    """How many times were at most that long, by bound."""
    total: float
    """All of them together, in seconds."""

    @classmethod
    def of(cls, below: Mapping[float, float], total: float) -> Histogram | None:
        """From how many were at most so long, by bound; None where there are none."""
        bounds = sorted(below)
        counts: list[float] = []
        for bound in bounds:  # a process that ended between two readings may leave them out of step
            counts.append(max(below[bound], counts[-1] if counts else 0.0))
        if not bounds or not math.isinf(bounds[-1]) or round(counts[-1]) < 1:
            return None
        return cls(bounds, counts, total)

    @property
    def count(self) -> int:
        """How many times there are."""
        return round(self.counts[-1])

    @property
    def mean(self) -> float:
        """In seconds; it is exact, unlike quantiles."""
        return self.total / self.counts[-1]

    def quantile(self, fraction: float) -> float:
        """The time below which this fraction of them lies, linearly between the bounds about it, as ``histogram_quantile`` has it.

        The last finite bound where it lies beyond that: it is longer then, nobody knows by how much.
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
        """Whether that quantile lies beyond the last finite bound."""
        return len(self.counts) > 1 and fraction * self.counts[-1] > self.counts[-2]

    def buckets(self) -> Iterator[Bucket]:
        """The times from bound to bound."""
        above, before = 0.0, 0.0
        for bound, count in zip(self.bounds, self.counts, strict=True):
            yield Bucket(above, bound, count - before)
            above, before = bound, count
