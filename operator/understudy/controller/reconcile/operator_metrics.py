"""The operator's Prometheus metrics."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector

from understudy.kube import api_traffic
from understudy.process import loop_turns

REGISTRY = CollectorRegistry()
ProcessCollector(registry=REGISTRY)

RECONCILED = Counter(
    "understudy_reconciliations_total", "Reconciliations by kind and result.", ["kind", "result"], registry=REGISTRY
)
SECONDS = Histogram(
    "understudy_reconciliation_seconds",
    "Time of one reconciliation.",
    ["kind"],
    registry=REGISTRY,
    buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10),
)
WRITES = Counter(
    "understudy_writes_total", "Writes to the API by resource and verb.", ["resource", "verb"], registry=REGISTRY
)
WAITING = Gauge("understudy_queue_length", "Objects waiting to be reconciled.", registry=REGISTRY)
ROLLOUTS = Gauge(
    "understudy_monitor_rollouts",
    "Workloads whose monitor or discovery server is to be replaced: under_way, or waiting for their turn.",
    ["state"],
    registry=REGISTRY,
)
LEADER = Gauge("understudy_leader", "1 while this replica holds the lease.", registry=REGISTRY)
POOL_SIZE = Gauge(
    "understudy_pool_size",
    "Unclaimed pods that a shared pool should hold, if spec.sizing determines the number.",
    ["namespace", "pool"],
    registry=REGISTRY,
)
POOL_NEEDED = Gauge(
    "understudy_pool_size_needed",
    "Pods that would be enough for spec.sizing.risk at the expected rate of requests, without regard to min and max.",
    ["namespace", "pool"],
    registry=REGISTRY,
)
POOL_FAILURES = Gauge(
    "understudy_pool_failures_per_robot_hour",
    "Expected requests for a pod of the pool, per robot and hour.",
    ["namespace", "pool"],
    registry=REGISTRY,
)
_STORM = Gauge(
    "understudy_storm",
    "1 while so many workloads of a policy fail at once that recoveries are held.",
    ["namespace", "policy"],
    registry=REGISTRY,
)
_POLICY_MAPS = Gauge(
    "understudy_policy_map_used_ratio",
    "Share of Cilium's policy map that an instance of a workload needs; above 1, Cilium no longer enforces changes of the gate.",
    ["namespace", "workload"],
    registry=REGISTRY,
)
MISSED = Counter(
    "understudy_watch_missed_total",
    "Changes that the watches missed and a list of all objects showed, by resource.",
    ["resource"],
    registry=REGISTRY,
)
RESYNC_SECONDS = Gauge(
    "understudy_last_resync_seconds", "Seconds that the last list of all objects took.", registry=REGISTRY
)
RESYNCED = Gauge(
    "understudy_last_resync_timestamp_seconds",
    "When all objects were last listed (Unix time in seconds).",
    registry=REGISTRY,
)

_REQUESTS, _HEARD = api_traffic.series(REGISTRY)
_BUSY = loop_turns.series(REGISTRY)
LONG_TURNS = loop_turns.reporter(_BUSY)
TRAFFIC = api_traffic.Traffic(_REQUESTS, _HEARD)


def storm(namespace: str, policy: str, on: bool | None) -> None:
    """Set whether a storm is in progress for a policy. None removes the metric, for a policy without a storm guard."""
    if on is not None:
        _STORM.labels(namespace, policy).set(float(on))
        return
    with contextlib.suppress(KeyError):
        _STORM.remove(namespace, policy)


def policy_maps(shares: Mapping[tuple[str, str], float]) -> None:
    """Set the used share of the policy maps, by the namespace and the name of each workload of which it is known."""
    _POLICY_MAPS.clear()
    for labels, share in shares.items():
        _POLICY_MAPS.labels(*labels).set(share)
