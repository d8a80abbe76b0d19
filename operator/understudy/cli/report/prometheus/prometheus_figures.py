"""Reads the data of Prometheus for the period: all recoveries, also those that no status records any more.

It has counts and distributions of times by strategy, but no single recoveries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from understudy.cli.common.text.time_bars import NAMES
from understudy.cli.report.prometheus import promql
from understudy.cli.report.prometheus.histograms import Histogram
from understudy.cli.report.prometheus.prometheus_client import Prometheus, Series
from understudy.cli.report.recovery_records import Span

LOOKS = 240
"""Number of steps in charts over time."""

WHOLE = "whole"
"""Key of the recovery time itself, next to its parts."""

Key = tuple[str, ...]


@dataclass(frozen=True)
class Count:
    """The number of events of one kind."""

    kind: str
    """Recovery, Switchover, or Held: a failure whose recovery was deferred."""
    how: str
    """The strategy, the kind of switchover, or the reason."""
    result: str
    count: int


class Time(NamedTuple):
    """The times of one part by strategy."""

    strategy: str
    part: str
    """One of the four, or :data:`WHOLE`."""
    histogram: Histogram


class Step(NamedTuple):
    """The times of another step."""

    name: str
    histogram: Histogram


@dataclass(frozen=True)
class Pool:
    """A pool in the period. Its pods exclude claimed ones unless stated otherwise."""

    namespace: str
    name: str
    desired: float
    """At the end of the period."""
    least_ready: float
    mean_ready: float
    most_claimed: float
    most_waiting: float
    """Most robots that waited for one of its pods."""
    ready: Sequence[tuple[float, float]]
    """Times with the number of ready pods."""
    wanted: Sequence[tuple[float, float]]
    """Times with the desired number of pods."""


@dataclass(frozen=True)
class Measured:
    """All data of Prometheus."""

    url: str
    period: Span
    seen: Sequence[float]
    """The queried times at which there was data of monitors of these robots."""
    asked: int
    """The number of queried times."""
    step: float
    """Seconds between two queried times."""
    counts: Sequence[Count] = ()
    times: Sequence[Time] = ()
    steps: Sequence[Step] = ()
    pools: Sequence[Pool] = ()
    recovered: int | None = None
    """The increase of the operator's own count, including planned ones; None if there is no data."""

    @property
    def strategies(self) -> Sequence[str]:
        """The strategies with recoveries, the slowest first, as in the paper."""
        mean = {time.strategy: time.histogram.mean for time in self.times if time.part == WHOLE}
        return sorted({time.strategy for time in self.times}, key=lambda one: (-mean.get(one, 0.0), one))

    def of(self, strategy: str) -> Mapping[str, Histogram]:
        """Return the times of each part for one strategy."""
        found = {time.part: time.histogram for time in self.times if time.strategy == strategy}
        return {part: found[part] for part in (*NAMES, WHOLE) if part in found}

    def counted(self, *kinds: str, result: str | None = None) -> int:
        """Return the number of events of these kinds."""
        return sum(c.count for c in self.counts if c.kind in kinds and result in (None, c.result))

    def named(self, pool: Pool) -> str:
        """Return a pool's name, with its namespace if there are several namespaces."""
        several = len({one.namespace for one in self.pools}) > 1
        return f"{pool.namespace}/{pool.name}" if several else pool.name

    @property
    def missed(self) -> int:
        """Recoveries that the operator counted and the monitors' series do not include."""
        return max(0, (self.recovered or 0) - self.counted("Recovery", "Switchover"))


def measured(prometheus: Prometheus, period: Span, *, namespace: str | None, names: Sequence[str] = ()) -> Measured:
    """Query all data; for all namespaces and robots if none are named. Raises CommandError."""
    where, end = promql.selector(namespace, names), period.end

    def query(expression: str) -> Sequence[Series]:
        return prometheus.query(expression, end)

    def came(labels: str, metric: str) -> dict[Key, float]:
        return _by(query(promql.came_to(labels, metric, where, period)), labels)

    def histograms(labels: str, metric: str) -> dict[Key, Histogram]:
        sums = came(labels, f"{metric}_sum")
        below: dict[Key, dict[float, float]] = {}
        for key, count in came(", ".join(part for part in (labels, "le") if part), f"{metric}_bucket").items():
            below.setdefault(key[:-1], {})[float(key[-1])] = count
        found = {key: Histogram.of(counts, sums.get(key, 0.0)) for key, counts in sorted(below.items())}
        return {key: histogram for key, histogram in found.items() if histogram is not None}

    step = period.length / LOOKS
    alive = prometheus.range(f"count({promql.ALIVE}{where})", period.begin, end, step)
    whole = histograms("strategy", "understudy_recovery_seconds")
    parts = histograms("strategy, part", "understudy_recovery_part_seconds")
    recovered = query(promql.recovered(where, period))
    return Measured(
        url=prometheus.url,
        period=period,
        seen=[at for series in alive for at, _ in series.points],
        asked=LOOKS + 1,
        step=step,
        counts=list(_counts(came)),
        times=[
            *(Time(strategy, part, histogram) for (strategy, part), histogram in parts.items()),
            *(Time(strategy, WHOLE, histogram) for (strategy,), histogram in whole.items()),
        ],
        steps=[
            Step(", ".join((name, *(value.lower() for value in key))), histogram)
            for name, labels, metric in _STEPS
            for key, histogram in histograms(labels, metric).items()
        ],
        pools=_pools(prometheus, period, namespace, step),
        recovered=round(recovered[0].value) if recovered else None,
    )


_STEPS = (
    ("claim of a pod", "result", "understudy_claim_seconds"),
    ("wait for a pod", "result", "understudy_pool_wait_seconds"),
    ("change of the gate", "", "understudy_gate_commit_seconds"),
    ("gap of a switchover", "kind", "understudy_switchover_gap_seconds"),
    ("lateness of a detection", "", "understudy_detection_lateness_seconds"),
)


def _counts(came: Callable[[str, str], Mapping[Key, float]]) -> Iterator[Count]:
    for kind, labels, metric in (
        ("Recovery", "strategy, result", "understudy_recoveries_total"),
        ("Switchover", "kind, result", "understudy_switchovers_total"),
        ("Held", "why", "understudy_recoveries_held_total"),
    ):
        for (how, *result), count in sorted(came(labels, metric).items()):
            if round(count):
                yield Count(kind, how, "".join(result), round(count))


def _pools(prometheus: Prometheus, period: Span, namespace: str | None, step: float) -> Sequence[Pool]:
    by = "namespace, pool"
    all_, ready, claimed = (
        promql.selector(namespace, **state) for state in ({}, {"state": "ready"}, {"state": "claimed"})
    )

    def gauge(function: str, way: str, series: str) -> dict[Key, float]:
        return _by(prometheus.query(promql.over(function, way, by, series, period), period.end), by)

    def drawn(series: str) -> dict[Key, Sequence[tuple[float, float]]]:
        found = prometheus.range(f"max by ({by}) ({series})", period.begin, period.end, step)
        return {_key(one, by): one.points for one in found}

    least, mean = gauge("min", "min", _PODS + ready), gauge("avg", "avg", _PODS + ready)
    most, waiting = gauge("max", "max", _PODS + claimed), gauge("max", "max", _WAITING + all_)
    desired, had, wanted = gauge("last", "max", _DESIRED + all_), drawn(_PODS + ready), drawn(_DESIRED + all_)
    return [
        Pool(
            namespace=key[0],
            name=key[1],
            desired=desired.get(key, 0.0),
            least_ready=least[key],
            mean_ready=mean[key],
            most_claimed=most.get(key, 0.0),
            most_waiting=waiting.get(key, 0.0),
            ready=had.get(key, ()),
            wanted=wanted.get(key, ()),
        )
        for key in sorted(least)
    ]


_PODS, _DESIRED, _WAITING = "understudy_pool_pods", "understudy_pool_desired_pods", "understudy_pool_waiting_workloads"


def _by(found: Iterable[Series], labels: str) -> dict[Key, float]:
    return {_key(series, labels): series.value for series in found}


def _key(series: Series, labels: str) -> Key:
    return tuple(series.labels.get(label, "") for label in labels.split(", ") if label)
