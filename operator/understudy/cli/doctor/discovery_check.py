"""Checks whether the discovery server of each workload answers, by joining the robot's ROS graph from a pod of the
namespace."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.common.text.wording import counted
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.test_pods import Pods
from understudy.controller.observed import kube_objects
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.kube.client import CONFIG_MAPS, PODS, Object
from understudy.kube.gates.registry import DEFAULT
from understudy.ros.rmw import MIDDLEWARE

WITHIN = 8.0
"""Seconds without another node after which a graph counts as empty; discovery takes less than one."""

ALTOGETHER = 150.0
"""Seconds after which no further graph is joined: the lifetime of the pods is limited, and so is the user's
patience."""

SILENT = 3
"""Number of graphs without any node after which no further graph is joined."""


def check(workload: Object) -> str:
    """Return the name of the check of a workload."""
    return f"discovery of {kube_objects.name(workload)}"


def servers(api: Api, namespace: str, workloads: Sequence[Object]) -> Iterator[Finding]:
    """Find, without a packet, managed servers that do not run, and why."""
    for workload in workloads:
        if not _is_managed(workload):
            continue
        name = kube_objects.name(workload)
        selector = f"{names.COMPONENT}=discovery,{names.MONITORED}={name}"
        pods = api.get(f"{PODS.path(namespace)}?labelSelector={selector}")["items"]
        if any(kube_objects.ready(pod) for pod in pods):
            continue
        why = next((found.message for found in map(trouble, pods) if found is not None), "")
        yield Finding(
            check(workload),
            "FAIL",
            f"its server does not run{f': {why}' if why else ''}",
            "processes that know each other continue, but new ones cannot join: see kubectl describe deployment -n "
            f"{namespace} {names.discovery(name)}",
        )


def joined(pods: Pods, workloads: Sequence[Object], progress: Callable[[str], None]) -> Iterator[Finding]:
    """Join each workload's graph and report the nodes found there. Raises CommandError."""
    if not workloads:
        return
    end, silent = time.monotonic() + ALTOGETHER, 0
    with pods.talking(pods.receiver, "graph") as talk:
        for number, workload in enumerate(workloads):
            if silent >= SILENT or time.monotonic() > end:
                yield Finding(
                    "discovery of other workloads",
                    "WARN",
                    f"{counted(len(workloads) - number, 'graph was', 'graphs were')} not joined, because "
                    f"{f'{silent} graphs had no node' if silent >= SILENT else f'the time of {ALTOGETHER:g} s was over'}",
                    "name the workloads to check: understudy doctor NAME",
                )
                return
            progress(f"joining the ROS graph of {kube_objects.name(workload)}")
            environment = _environment(pods.api, pods.kubectl.namespace, kube_objects.name(workload))
            if environment is None:
                yield Finding(
                    check(workload),
                    "WARN",
                    f"ConfigMap {names.robot_env(kube_objects.name(workload))} is not there yet",
                    f"understudy explain {kube_objects.name(workload)} says what it waits for",
                )
                continue
            nodes = talk.ask("graph", takes=WITHIN, environment=environment, seconds=WITHIN)
            silent += not nodes
            yield judge(workload, environment, nodes)


def judge(workload: Object, environment: Mapping[str, str], nodes: Sequence[str]) -> Finding:
    """Judge a workload's graph by the nodes that were found in it."""
    server = MIDDLEWARE.discovery_server(environment)
    by = f"by {server}" if server else "without a server"
    if nodes:
        others = f", such as {nodes[0]}" if len(nodes) > 1 else f": {nodes[0]}"
        return Finding(check(workload), "OK", f"{counted(len(nodes), 'node')} found {by}{others}")
    name = kube_objects.name(workload)
    found = f"no node is found {by} within {WITHIN:g} s, not even the monitor"
    if _is_managed(workload):
        cure = (
            f"check whether the Service {names.discovery(name)} has endpoints (kubectl get endpointslices), whether a "
            f"{DEFAULT.object_kind} of this namespace keeps pods from UDP {names.DISCOVERY_PORT}, and whether the monitor runs: "
            f"understudy explain {name}"
        )
    elif server:
        cure = f"look whether a {MIDDLEWARE.name} discovery server runs at {server} and pods reach it (spec.ros.discovery.server)"
    else:
        cure = "most pod networks carry no multicast: use spec.ros.discovery.mode Managed"
    return Finding(check(workload), "FAIL", found, cure)


def _is_managed(workload: Object) -> bool:
    ros = (workload["spec"].get("ros") or {}).get("discovery") or {}
    return bool(ros.get("mode", "Managed") == "Managed")


def _environment(api: Api, namespace: str, workload: str) -> dict[str, str] | None:
    """Return the environment of a robot's ROS graph without the paths of profiles, with which this pod would take the
    robot's place."""
    try:
        data = api.get(CONFIG_MAPS.path(namespace, names.robot_env(workload))).get("data") or {}
    except Refused as refused:
        if refused.status != 404:
            raise
        return None
    return {key: value for key, value in data.items() if key != MIDDLEWARE.settings_variable}
