"""Metrics of the workloads and pools, calculated for each scrape.

They come from the same objects that ``kubectl get`` shows. So they need no counters, and are correct after a restart.
Only the leading replica exports them, because two replicas would export everything twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from understudy.controller.observed import kube_objects
from understudy.controller.reconcile.object_store import Store
from understudy.kube.client import POOLS, WORKLOADS, Object

CONDITIONS = ("Accepted", "Reconciled", "Protected", "Monitored", "GateEnforced", "SoleDriver")
"""Conditions of a workload that may need an alert while they are not True."""

_OF_WORKLOAD = ["namespace", "workload"]
_OF_POOL = ["namespace", "pool"]


class FleetMetrics(Collector):
    """The RobotWorkloads and FallbackPools of a store."""

    def __init__(self, store: Store, leading: Callable[[], bool]) -> None:
        self._store, self._leading = store, leading

    def describe(self) -> Iterable[Metric]:
        """Return the metrics without samples, for registration."""
        return [*_workloads([]), *_pools([])]

    def collect(self) -> Iterable[Metric]:
        """Return all metrics as of now; none while another replica leads."""
        if not self._leading():
            return []
        return [*_workloads(self._store.all(WORKLOADS)), *_pools(self._store.all(POOLS))]


def _workloads(items: Iterable[Object]) -> list[Metric]:
    health = GaugeMetricFamily(
        "understudy_workload_health", "1 for the current health of a workload.", labels=[*_OF_WORKLOAD, "health"]
    )
    conditions = GaugeMetricFamily(
        "understudy_workload_condition",
        "1 if a condition of a workload is True, else 0, with its reason.",
        labels=[*_OF_WORKLOAD, "condition", "reason"],
    )
    recoveries = CounterMetricFamily(
        "understudy_workload_recoveries",
        "Recoveries of a workload since it was created, regardless of their result.",
        labels=_OF_WORKLOAD,
    )
    last = GaugeMetricFamily(
        "understudy_workload_last_recovery_timestamp_seconds",
        "When a workload was last recovered (Unix time).",
        labels=_OF_WORKLOAD,
    )
    for item in items:
        labels = [item["metadata"]["namespace"], kube_objects.name(item)]
        status = item.get("status") or {}
        health.add_metric([*labels, status.get("health") or "Unknown"], 1)
        for found in status.get("conditions") or []:
            if found["type"] in CONDITIONS:
                conditions.add_metric([*labels, found["type"], found["reason"]], float(found["status"] == "True"))
        recoveries.add_metric(labels, status.get("recoveryCount") or 0)
        if moment := status.get("lastRecoveryTime"):
            last.add_metric(labels, datetime.fromisoformat(moment).timestamp())
    return [health, conditions, recoveries, last]


def _pools(items: Iterable[Object]) -> list[Metric]:
    pods = GaugeMetricFamily(
        "understudy_pool_pods",
        "Pods of a pool by state: ready to take over, unready, or claimed (they drive a robot).",
        labels=[*_OF_POOL, "state"],
    )
    desired = GaugeMetricFamily(
        "understudy_pool_desired_pods", "Unclaimed pods that a pool should have.", labels=_OF_POOL
    )
    waiting = GaugeMetricFamily(
        "understudy_pool_waiting_workloads", "Workloads that wait for a pod of a pool.", labels=_OF_POOL
    )
    for item in items:
        labels = [item["metadata"]["namespace"], kube_objects.name(item)]
        status: Mapping[str, int | None] = item.get("status") or {}
        ready, there = status.get("ready") or 0, status.get("replicas") or 0
        for state, count in (
            ("ready", ready),
            ("unready", max(0, there - ready)),
            ("claimed", status.get("claimed") or 0),
        ):
            pods.add_metric([*labels, state], count)
        desired.add_metric(labels, status.get("desired") or 0)
        waiting.add_metric(labels, status.get("waiting") or 0)
    return [pods, desired, waiting]
