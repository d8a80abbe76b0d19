"""Checks what workloads with a mux need, by requests to the API server: their objects, and the pod of the mux."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.doctor.findings import Finding
from understudy.cli.manifests import mux_container
from understudy.controller.observed import kube_objects
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.kube.client import CONFIG_MAPS, PODS, SECRETS, Object, Resource
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import NO_MUX

_NO_REPORT = (NO_MUX, "Settling")
"""Reasons of the condition GateEnforced from before a mux has reported."""


def check(api: Api, namespace: str, workloads: Sequence[Object]) -> Iterator[Finding]:
    """Yield a finding for each workload with a mux, and one about its gate if something is wrong."""
    muxed = [one for one in workloads if registry.of(one).is_at_robot]
    if not muxed:
        return
    pods = api.get(PODS.path(namespace))["items"]
    for workload in muxed:
        yield _mux(api, namespace, workload, pods)
        yield from _gate(api, namespace, workload)


def _mux(api: Api, namespace: str, workload: Object, pods: Sequence[Object]) -> Finding:
    """Check the objects that a mux needs, and its pod."""
    name = kube_objects.name(workload)
    check, mux = f"mux of {name}", names.mux(name)
    for kind, resource in (("ConfigMap", CONFIG_MAPS), ("Secret", SECRETS)):
        if _exists(api, resource, namespace, mux) is False:
            cure = f"the operator writes it for a workload that it accepts: understudy explain {name}"
            return Finding(check, "FAIL", f"{kind} {mux} does not exist, so no mux can run", cure)
    status = workload.get("status") or {}
    enforced = [one["reason"] for one in status.get("conditions") or [] if one["type"] == "GateEnforced"]
    reports = any(reason not in _NO_REPORT for reason in enforced)
    running = [pod for pod in pods if kube_objects.alive(pod) and mux_container.path(pod["spec"], mux)]
    if not running:
        where = f"no pod of {namespace} has the environment of ConfigMap {mux}"
        if reports:
            return Finding(check, "OK", f"it reports; {where}, so it runs elsewhere")
        return Finding(
            check,
            "FAIL",
            f"it does not report, and {where}",
            "run it beside the robot's drivers, in their pod or outside of the cluster: docs/mux.md",
        )
    if len(running) > 1:
        listed = ", ".join(sorted(map(kube_objects.name, running)))
        cure = "each order names one of them, and the others forward nothing: run one, with the strategy Recreate"
        return Finding(check, "FAIL", f"{len(running)} pods run it: {listed}", cure)
    (pod,) = running
    where = f"pod {kube_objects.name(pod)}"
    if (found := trouble(pod)) is not None:
        return Finding(check, "FAIL", found.message, "nothing that the instances send reaches the robot until it runs")
    if lacks := list(mux_container.problems(pod["spec"], name)):
        return Finding(check, "FAIL", f"{where}: {lacks[0]}", "as in examples/quickstart/manifests/mux/robot.yaml")
    if not reports:
        cure = (
            f"see its log (kubectl logs -n {namespace} {kube_objects.name(pod)}), and whether it and the monitor join one ROS graph: the "
            f"line discovery of {name}"
        )
        return Finding(check, "WARN", f"{where} runs it, but the monitor receives no report of it", cure)
    if cure := mux_container.forgotten(pod["spec"], name):
        return Finding(check, "WARN", f"{where} runs it, and it reports, but an instance on board needs more", cure)
    return Finding(check, "OK", f"{where} runs it, and it reports")


def _gate(api: Api, namespace: str, workload: Object) -> Iterator[Finding]:
    """Check whether the gate object is there, and lets through whom its record names."""
    name, kind = kube_objects.name(workload), registry.of(workload)
    check, what = f"gate of {name}", f"{kind.object_kind} {names.gate(name)}"
    try:
        gate = api.get(kind.resource.path(namespace, names.gate(name)))
    except Refused as refused:
        if refused.status == 404:
            cure = f"the operator creates it for a workload that it accepts: understudy explain {name}"
            yield Finding(check, "FAIL", f"{what} does not exist, so no instance is in control", cure)
        return
    record = GateRecord.of(gate)
    if kind.routing_repair(gate, name, record.active, record.admitted):
        yield Finding(
            check,
            "FAIL",
            f"{what} lets through {', '.join(kind.let_through(gate)) or 'nobody'}, but its record names {record.active or 'nobody'}",
            "somebody else has written it. The mux follows the record; the operator restores the rest unless the workload is paused",
        )


def _exists(api: Api, resource: Resource, namespace: str, name: str) -> bool | None:
    """Return whether an object exists; None if the user may not read it."""
    try:
        api.get(resource.path(namespace, name))
    except Refused as refused:
        return False if refused.status == 404 else None
    return True
