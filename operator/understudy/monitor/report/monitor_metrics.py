"""Prometheus metrics of the monitor."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import get_args

from prometheus_client import REGISTRY, Counter, Gauge, Histogram

from understudy.api.kinds.robot_workload import Health, Recovery
from understudy.kube import api_traffic

_WRITES = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5)
"""Buckets for answers of the API server, in seconds."""

_RECOVERIES = Counter("understudy_recoveries", "Recoveries of this workload.", ["strategy", "result"])
_TIMES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60)
_SECONDS = Histogram(
    "understudy_recovery_seconds",
    "From the last healthy output of the failed instance until the gate was open for the next one (the sum of the parts).",
    ["strategy"],
    buckets=_TIMES,
)
_PARTS = Histogram(
    "understudy_recovery_part_seconds",
    "Parts of the recovery time (equation 1 of the paper).",
    ["strategy", "part"],
    buckets=_TIMES,
)
_HEALTH = Gauge("understudy_health", "1 for the present health of this workload.", ["health"])
_EPOCH = Gauge("understudy_gate_epoch", "Epoch of the gate.")
_LATENESS = Histogram(
    "understudy_detection_lateness_seconds",
    "How long after its deadline a failure was detected.",
    buckets=(0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.05, 0.1, 0.5),
)
_WAITS = Histogram(
    "understudy_pool_wait_seconds",
    "How long this workload waited for a pod of a shared pool, until it was served or gave up.",
    ["pool", "result"],
    buckets=(0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300),
)
_LOOKS = Counter("understudy_tree_evaluations", "Looks at the health tree.")
_OVERRUNS = Counter(
    "understudy_tree_overruns",
    "Looks at the health tree that came so late that silence can't be judged by them at once.",
)
_CLAIMS = Histogram(
    "understudy_claim_seconds",
    "How long the claim of a pod of a shared pool took, by what came of it.",
    ["result"],
    buckets=_WRITES,
)
_GATES = Histogram(
    "understudy_gate_commit_seconds", "How long the API server took for a change of the gate.", buckets=_WRITES
)
_SWITCHOVERS = Counter("understudy_switchovers", "Planned switchovers of this workload.", ["kind", "result"])
_SWITCHOVER_GAP = Histogram(
    "understudy_switchover_gap_seconds",
    "From the last output of the former instance to the first of the next one, in planned switchovers.",
    ["kind"],
    buckets=(0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5),
)
_DEGRADATIONS = Counter("understudy_degradations", "How often this workload became degraded.")
_SITUATION = Gauge("understudy_situation", "1 for the situation that the robot is in, by its policy.", ["situation"])
_BUDGET = Gauge("understudy_budget_left", "Recoveries that limits.budget has left, by its window.", ["within"])
_PAUSED = Gauge("understudy_paused", "1 while spec.pause is in force.")
_HELD = Counter("understudy_recoveries_held", "Failures that were not recovered at once, by what held them.", ["why"])
_KEPT_AT = Gauge("understudy_kept_timestamp_seconds", "When the state was taken that would be restored now.", ["name"])
_KEPT_BYTES = Gauge("understudy_kept_bytes", "Size of the state that would be restored now.", ["name"])
_REQUESTS, _HEARD = api_traffic.series(REGISTRY)
TRAFFIC = api_traffic.Traffic(_REQUESTS, _HEARD)


def health(value: Health) -> None:
    """Set the present health."""
    for each in get_args(Health):
        _HEALTH.labels(health=each).set(1.0 if each == value else 0.0)


def degraded() -> None:
    """Count that the workload became degraded."""
    _DEGRADATIONS.inc()


def situation(name: str | None) -> None:
    """Set the present situation; None for none."""
    _SITUATION.clear()
    if name is not None:
        _SITUATION.labels(situation=name).set(1.0)


def budget(within: str, left: int | None) -> None:
    """Set what a budget has left; None where there is none."""
    _BUDGET.clear()
    if left is not None:
        _BUDGET.labels(within=within).set(left)


def paused(value: bool) -> None:
    """Set whether it is paused."""
    _PAUSED.set(1.0 if value else 0.0)


def held(why: str) -> None:
    """Count a failure that isn't recovered at once."""
    _HELD.labels(why=why).inc()


def epoch(value: int) -> None:
    """Set the gate's epoch."""
    _EPOCH.set(value)


def kept(entries: Mapping[str, tuple[float | None, int]]) -> None:
    """Set when each part of the kept state was taken (unix seconds), and its bytes."""
    _KEPT_AT.clear()
    _KEPT_BYTES.clear()
    for name, (taken_at, size) in entries.items():
        if taken_at is not None:
            _KEPT_AT.labels(name=name).set(taken_at)
            _KEPT_BYTES.labels(name=name).set(size)


def waited(pool: str, result: str, seconds: float) -> None:
    """Note how long a pod of a shared pool was waited for, and what came of it."""
    _WAITS.labels(pool=pool, result=result).observe(max(0.0, seconds))


def lateness(seconds: float) -> None:
    """Note how late a detection was."""
    _LATENESS.observe(max(0.0, seconds))


def looked(overrun: bool) -> None:
    """Count a look at the health tree, and whether it was much too late."""
    _LOOKS.inc()
    if overrun:
        _OVERRUNS.inc()


def claimed(result: str, seconds: float) -> None:
    """Note how long a claim took: Won, or Lost to another workload."""
    _CLAIMS.labels(result=result).observe(max(0.0, seconds))


def committed(seconds: float) -> None:
    """Note how long a change of the gate took."""
    _GATES.observe(max(0.0, seconds))


def recovered(recovery: Recovery) -> None:
    """Count a finished recovery and its parts. A planned switchover isn't one."""
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
