"""Prometheus metrics of the monitor: counted from notices, or read from its observations when Prometheus asks.

A new metric needs only this module, unless it measures something that no notice reports yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from typing import get_args

from prometheus_client import REGISTRY, Counter, Gauge, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from understudy.api.kinds.robot_workload import Health, Recovery
from understudy.kube import api_traffic
from understudy.monitor.notices import (
    BecameDegraded,
    BudgetCounted,
    FailureDetected,
    GateCommitted,
    LeaksCounted,
    Notice,
    PauseChanged,
    PodAwaited,
    PodClaimed,
    PublishedStatus,
    RecoveryDeferred,
    RecoveryRecorded,
    StateKept,
    StatusChanged,
)
from understudy.process import loop_turns
from understudy.trees.core.observations import TopicRecord

_WRITES = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5)
"""Buckets for answers of the API server, in seconds."""

_RECOVERIES = Counter("understudy_recoveries", "Recoveries of this workload.", ["strategy", "result"])
_TIMES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60)
_SECONDS = Histogram(
    "understudy_recovery_seconds",
    "Seconds from the last healthy output of the failed instance until the gate was open for the next one.",
    ["strategy"],
    buckets=_TIMES,
)
_PARTS = Histogram(
    "understudy_recovery_part_seconds",
    "Seconds that each part of a recovery took; their sum is understudy_recovery_seconds.",
    ["strategy", "part"],
    buckets=_TIMES,
)
_HEALTH = Gauge(
    "understudy_health", "1 for the current health of this workload, and 0 for every other one.", ["health"]
)
_EPOCH = Gauge("understudy_gate_epoch", "Epoch of the gate.")
_LATENESS = Histogram(
    "understudy_detection_lateness_seconds",
    "Seconds from the moment at which a failure could be detected until the monitor detected it.",
    buckets=(0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.05, 0.1, 0.5),
)
_WAITS = Histogram(
    "understudy_pool_wait_seconds",
    "Seconds that this workload waited for a pod of a shared pool, until it got one or gave up.",
    ["pool", "result"],
    buckets=(0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300),
)
_CLAIMS = Histogram(
    "understudy_claim_seconds",
    "Seconds that it took to claim a pod of a shared pool, by the result.",
    ["result"],
    buckets=_WRITES,
)
_GATES = Histogram(
    "understudy_gate_commit_seconds", "Seconds that the API server took to change the gate.", buckets=_WRITES
)
_SWITCHOVERS = Counter("understudy_switchovers", "Planned switchovers of this workload.", ["kind", "result"])
_SWITCHOVER_GAP = Histogram(
    "understudy_switchover_gap_seconds",
    "Seconds from the last output of the former instance to the first of the next one, in planned switchovers.",
    ["kind"],
    buckets=(0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5),
)
_DEGRADATIONS = Counter("understudy_degradations", "How often this workload became degraded.")
_SITUATION = Gauge(
    "understudy_situation",
    "1 for the situation of the policy that the robot is in; other situations have no series.",
    ["situation"],
)
_BUDGET = Gauge("understudy_budget_left", "Recoveries that limits.budget has left, by its window.", ["within"])
_PAUSED = Gauge("understudy_paused", "1 while the workload is paused (spec.pause).")
_LEAKS = Gauge(
    "understudy_leaking_instances", "Instances that reach the robot although the gate does not let them through."
)
_HELD = Counter(
    "understudy_recoveries_held", "Failures that were not recovered at once, by the limit that deferred them.", ["why"]
)
_KEPT_AT = Gauge(
    "understudy_kept_timestamp_seconds", "When the state that would be restored now was captured (Unix time).", ["name"]
)
_KEPT_BYTES = Gauge("understudy_kept_bytes", "Size in bytes of the state that would be restored now.", ["name"])
_REQUESTS, _HEARD = api_traffic.series(REGISTRY)
_BUSY = loop_turns.series(REGISTRY)
LONG_TURNS = loop_turns.reporter(_BUSY)
TRAFFIC = api_traffic.Traffic(_REQUESTS, _HEARD)


def count(notice: Notice) -> None:
    """Update the metrics that follow from a notice."""
    match notice:
        case RecoveryRecorded(recovery=recovery):
            _recovered(recovery)
        case StatusChanged(status=status):
            _status(status)
        case FailureDetected(late):
            _LATENESS.observe(max(0.0, late))
        case RecoveryDeferred(reason):
            _HELD.labels(why=reason).inc()
        case BecameDegraded():
            _DEGRADATIONS.inc()
        case PauseChanged(paused):
            _PAUSED.set(1.0 if paused else 0.0)
        case BudgetCounted(within, left):
            _BUDGET.clear()
            if left is not None:
                _BUDGET.labels(within=within).set(left)
        case StateKept(parts):
            _kept(parts)
        case PodAwaited(pool, result, seconds):
            _WAITS.labels(pool=pool, result=result).observe(max(0.0, seconds))
        case PodClaimed(result, seconds):
            _CLAIMS.labels(result=result).observe(max(0.0, seconds))
        case LeaksCounted(leaking):
            _LEAKS.set(leaking)
        case GateCommitted(seconds):
            _GATES.observe(max(0.0, seconds))


def _status(status: PublishedStatus) -> None:
    for each in get_args(Health):
        _HEALTH.labels(health=each).set(1.0 if each == status.health else 0.0)
    _EPOCH.set(status.gate.epoch)
    _SITUATION.clear()
    if status.situation is not None:
        _SITUATION.labels(situation=status.situation.name).set(1.0)


def _kept(parts: Mapping[str, tuple[float | None, int]]) -> None:
    _KEPT_AT.clear()
    _KEPT_BYTES.clear()
    for name, (taken_at, size) in parts.items():
        if taken_at is not None:
            _KEPT_AT.labels(name=name).set(taken_at)
            _KEPT_BYTES.labels(name=name).set(size)


def _recovered(recovery: Recovery) -> None:
    """Count a finished recovery and its parts. A planned switchover is not a recovery."""
    if recovery.switchover is not None:
        _switched(recovery, recovery.switchover)
        return
    strategy = recovery.strategy or "none"
    _RECOVERIES.labels(strategy=strategy, result=recovery.result).inc()
    if recovery.recovery_seconds is not None and recovery.result == "Recovered":
        _SECONDS.labels(strategy=strategy).observe(recovery.recovery_seconds)
    if recovery.parts is not None and recovery.result == "Recovered":
        for part, seconds in recovery.parts.model_dump().items():
            _PARTS.labels(strategy=strategy, part=part).observe(seconds)


def _switched(recovery: Recovery, kind: str) -> None:
    _SWITCHOVERS.labels(kind=kind, result=recovery.result).inc()
    last, first = recovery.moments.last_output, recovery.moments.first_output
    if recovery.result == "Recovered" and last is not None and first is not None:
        gap = (datetime.fromisoformat(first) - datetime.fromisoformat(last)).total_seconds()
        _SWITCHOVER_GAP.labels(kind=kind).observe(max(0.0, gap))


class ObservationMetrics(Collector):
    """Metrics that are read from the monitor's observations when Prometheus asks. No tree is evaluated for them."""

    def __init__(
        self, records: Callable[[], Mapping[str, TopicRecord]], evaluations: Callable[[], tuple[int, int]]
    ) -> None:
        """``records`` returns the records of received messages, by topic; ``evaluations`` returns the numbers of evaluations and
        overruns."""
        self._records, self._evaluations = records, evaluations

    def describe(self) -> Iterable[Metric]:
        """Return the metrics without samples. prometheus_client calls this at registration."""
        return [*_of_topics({}, 0.0), *_of_evaluations(0, 0)]

    def collect(self) -> Iterable[Metric]:
        """Return the metrics as of now."""
        return [*_of_topics(self._records(), time.time()), *_of_evaluations(*self._evaluations())]


def _of_evaluations(evaluations: int, overruns: int) -> list[Metric]:
    return [
        CounterMetricFamily("understudy_tree_evaluations", "Evaluations of the health tree.", value=evaluations),
        CounterMetricFamily(
            "understudy_tree_overruns",
            "Evaluations of the health tree that came so late that the monitor does not treat silence as a failure at once.",
            value=overruns,
        ),
    ]


def _of_topics(records: Mapping[str, TopicRecord], now: float) -> list[Metric]:
    messages = CounterMetricFamily(
        "understudy_topic_messages",
        "Messages of a watched topic that count for the active instance; their rate is the topic's rate.",
        labels=["topic"],
    )
    last = GaugeMetricFamily(
        "understudy_topic_last_message_timestamp_seconds",
        "When the last message of a watched topic was received (Unix time in seconds).",
        labels=["topic"],
    )
    gap = GaugeMetricFamily(
        "understudy_topic_longest_gap_seconds",
        "Longest time in seconds between two messages of a watched topic in the last minute or two, including the current silence.",
        labels=["topic"],
    )
    for topic, record in records.items():
        messages.add_metric([topic], record.count)
        if record.last is not None:
            last.add_metric([topic], record.last)
        if (longest := record.longest_gap(now)) is not None:
            gap.add_metric([topic], longest)
    return [messages, last, gap]
