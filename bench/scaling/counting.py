"""The API server's own counts: requests of operator and monitors separately, and everything that its watches sent.

Its metric of requests does not name their senders. The metric of flow control names the FlowSchema, and a schema can
select accounts, verbs and resources. So the bench has a schema for each kind of request that is counted. They have the
same priority as such requests have without them.
"""

from __future__ import annotations

import aiohttp

from bench.scaling.exposition import Reading, read
from understudy.kube.client import Access, Object

DISPATCHED = "apiserver_flowcontrol_dispatched_requests_total"
EVENTS, BYTES = "apiserver_watch_events_total", "apiserver_watch_events_sizes_sum"
WATCHES = "apiserver_longrunning_requests"
REQUESTS = "apiserver_request_total"
CPU = "process_cpu_seconds_total"
MEMORY = "process_resident_memory_bytes"
COLLECTIONS = "go_gc_duration_seconds_count"
NAMES = frozenset({DISPATCHED, EVENTS, BYTES, WATCHES, REQUESTS, CPU, MEMORY, COLLECTIONS})

PREFIX = "bench-"
WRITES = ("create", "update", "patch", "delete", "deletecollection")
MONITOR = {
    "claims": ["pods"],
    "gates": ["networkpolicies"],
    "status": ["robotworkloads/status"],
    "events": ["events"],
    "scale": ["replicasets/scale"],
}
"""Resources that monitors write, by name of the figure. For pods, these are claims, labels and deletions."""
OPERATOR = {
    "leases": ["leases"],
    "pods": ["pods"],
    "policies": ["networkpolicies"],
    "settings": ["configmaps"],
    "controllers": ["deployments", "replicasets", "replicasets/scale"],
    "workload status": ["robotworkloads/status"],
    "pool status": ["fallbackpools/status"],
    "policy status": ["failurepolicies/status"],
    "events": ["events"],
}


def _name(who: str, what: str) -> str:
    return f"{PREFIX}{who}-{what.replace(' ', '-')}"


def schemas(monitors: list[str], operator: str) -> list[Object]:
    """Return the FlowSchemas. ``monitors`` are the namespaces of the monitors' accounts; ``operator`` is that of the
    operator's."""
    found = []
    for who, namespaces, kinds in (("monitor", monitors, MONITOR), ("operator", [operator], OPERATOR)):
        subjects = [{"kind": "Group", "group": {"name": f"system:serviceaccounts:{n}"}} for n in namespaces]
        for what, resources in kinds.items():
            found.append(_schema(_name(who, what), 2000, subjects, WRITES, resources))
        found.append(_schema(_name(who, "other"), 2001, subjects, WRITES, ["*"]))
        found.append(_schema(_name(who, "reads"), 2002, subjects, ("get", "list"), ["*"]))
        found.append(_schema(_name(who, "watches"), 2002, subjects, ("watch",), ["*"]))
    return found


def _schema(name: str, precedence: int, subjects: list[Object], verbs: tuple[str, ...], resources: list[str]) -> Object:
    rule = {
        "subjects": subjects,
        "resourceRules": [
            {
                "verbs": list(verbs),
                "apiGroups": ["*"],
                "resources": resources,
                "namespaces": ["*"],
                "clusterScope": True,
            }
        ],
    }
    return {
        "apiVersion": "flowcontrol.apiserver.k8s.io/v1",
        "kind": "FlowSchema",
        "metadata": {"name": name},
        "spec": {
            "priorityLevelConfiguration": {"name": "workload-low"},
            "matchingPrecedence": precedence,
            "distinguisherMethod": {"type": "ByUser"},
            "rules": [rule],
        },
    }


def writes(reading: Reading, who: str) -> dict[str, float]:
    """Return the writes of ``monitor`` or ``operator`` by kind, for kinds that occurred, without the operator's lease
    and dry runs."""
    kinds = [*(MONITOR if who == "monitor" else OPERATOR), "other"]
    found = {kind: reading.total(DISPATCHED, flow_schema=_name(who, kind)) for kind in kinds if kind != "leases"}
    if who == "operator":
        found["pods"] -= dry_runs(reading)
    return {kind: count for kind, count in found.items() if count}


def dry_runs(reading: Reading) -> float:
    """Return the number of pods that were only validated by the API server (dry run). Only the operator requests that."""
    return reading.total(REQUESTS, resource="pods", dry_run="All")


def requests(reading: Reading, who: str, kind: str) -> float:
    """Return the number of ``reads`` or ``watches`` of ``monitor`` or ``operator``."""
    return reading.total(DISPATCHED, flow_schema=_name(who, kind))


async def fetch(access: Access) -> Reading:
    """Return the API server's present counts."""
    connector = aiohttp.TCPConnector(ssl=access.context)
    timeout = aiohttp.ClientTimeout(total=120)
    async with (
        aiohttp.ClientSession(connector=connector, timeout=timeout) as session,
        session.get(f"{access.server}/metrics", headers=_headers(access)) as response,
    ):
        response.raise_for_status()
        return read(await response.text(), NAMES)


def _headers(access: Access) -> dict[str, str]:
    return {"Authorization": f"Bearer {access.token}"} if access.token else {}
