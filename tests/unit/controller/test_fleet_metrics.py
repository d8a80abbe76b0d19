"""The operator's metrics of workloads and pools."""

from __future__ import annotations

from prometheus_client import CollectorRegistry

from tests.unit.controller.world import custom, workload
from understudy.controller.reconcile.object_store import Store
from understudy.controller.runtime.fleet_metrics import FleetMetrics
from understudy.kube.client import POOLS, WORKLOADS, Object


def exported(*workloads: Object, pools: tuple[Object, ...] = (), leading: bool = True) -> CollectorRegistry:
    store, registry = Store(), CollectorRegistry()
    for item in workloads:
        store.put(WORKLOADS, item)
    for item in pools:
        store.put(POOLS, item)
    registry.register(FleetMetrics(store, lambda: leading))
    return registry


STATUS: Object = {
    "health": "Recovering",
    "recoveryCount": 7,
    "lastRecoveryTime": "2026-01-02T03:04:05Z",
    "conditions": [
        {"type": "Protected", "status": "False", "reason": "StandbyNotReady"},
        {"type": "Monitored", "status": "True", "reason": "Monitored"},
        {"type": "Degraded", "status": "True", "reason": "Degraded"},
    ],
}


def test_metrics_report_health_conditions_and_recoveries_of_a_workload() -> None:
    registry = exported(workload("w", status=STATUS))
    of = {"namespace": "fleet", "workload": "w"}
    value = registry.get_sample_value
    assert value("understudy_workload_health", {**of, "health": "Recovering"}) == 1
    lacking = {**of, "condition": "Protected", "reason": "StandbyNotReady"}
    assert value("understudy_workload_condition", lacking) == 0
    assert value("understudy_workload_condition", {**of, "condition": "Monitored", "reason": "Monitored"}) == 1
    assert value("understudy_workload_recoveries_total", of) == 7
    assert value("understudy_workload_last_recovery_timestamp_seconds", of) == 1767323045


def test_metrics_omit_conditions_that_need_no_attention() -> None:
    samples = [s for family in exported(workload("w", status=STATUS)).collect() for s in family.samples]
    assert "Degraded" not in {s.labels.get("condition") for s in samples}


def test_metrics_count_a_workload_without_a_status() -> None:
    of = {"namespace": "fleet", "workload": "new"}
    registry = exported(workload("new"))
    assert registry.get_sample_value("understudy_workload_health", {**of, "health": "Unknown"}) == 1
    assert registry.get_sample_value("understudy_workload_recoveries_total", of) == 0
    assert registry.get_sample_value("understudy_workload_last_recovery_timestamp_seconds", of) is None


def test_metrics_report_the_pods_of_a_pool_by_state() -> None:
    pool = custom("FallbackPool", "cold", {"readiness": "Uninitialized"})
    pool["status"] = {"desired": 4, "replicas": 3, "ready": 1, "claimed": 2, "waiting": 5}
    registry = exported(pools=(pool,))
    of = {"namespace": "fleet", "pool": "cold"}
    states = {
        s: registry.get_sample_value("understudy_pool_pods", {**of, "state": s})
        for s in ("ready", "unready", "claimed")
    }
    assert states == {"ready": 1, "unready": 2, "claimed": 2}
    assert registry.get_sample_value("understudy_pool_desired_pods", of) == 4
    assert registry.get_sample_value("understudy_pool_waiting_workloads", of) == 5


def test_a_replica_that_is_not_the_leader_reports_no_metrics() -> None:
    assert not list(exported(workload("w", status=STATUS), leading=False).collect())
