"""Checks whether robots among the given files are in the network of a node.

No podSelector matches such a pod. An address block matches it, but on Cilium only with a setting. Which network the cluster has is not
known, so these are warnings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from pydantic import ValidationError

from understudy.api import names
from understudy.api.kinds.robot_workload import GatePeer
from understudy.cli.check import gated_pods
from understudy.cli.manifests import mux_container
from understudy.cli.manifests.check_findings import Finding
from understudy.cli.manifests.manifest_reader import Manifest, at, items
from understudy.kube import selectors
from understudy.kube.client import Object
from understudy.kube.gates import cilium

_NAME = "kubernetes.io/metadata.name"
"""The label of a namespace with its name, which the API server sets."""

_SETTING = f"set policy-cidr-match-mode: nodes in ConfigMap {cilium.SYSTEM}/{cilium.SETTINGS} ({cilium.PAGE})"


def check(ours: Sequence[Manifest], others: Sequence[Manifest]) -> Iterator[Finding]:
    """Yield the robots in the network of a node that instances may not reach."""
    nodes = [_node(one) for one in others if one.kind == "Node"]
    namespaces = {one.name: one.labels for one in others if one.kind == "Namespace"}
    matches_nodes = any(map(_matches_nodes, others))
    for workload in (one for one in ours if one.kind == "RobotWorkload" and one.name):
        if gated_pods.gate(workload).is_at_robot:
            continue
        robots = items(workload.data, "spec", "gate", "robots")
        if robots and matches_nodes:
            continue
        yield from _at_nodes(workload, robots, nodes)
        for pod in others:
            found = gated_pods.pod(pod)
            if found is None or at(found[1], "hostNetwork") is not True or not _is_robot(workload, pod, namespaces):
                continue
            yield pod.finding(f"{found[0]}.hostNetwork", _unreached(workload.name, named=bool(robots)), warning=True)


def _at_nodes(workload: Manifest, robots: Sequence[object], nodes: Sequence[Object]) -> Iterator[Finding]:
    for number, robot in enumerate(robots):
        for address, node in cilium.at_nodes([robot], nodes):
            message = (
                f"includes {address}, the address of node {node}, and on Cilium, address blocks match no node by default: if the cluster "
                f"has Cilium, {_SETTING}"
            )
            yield workload.finding(f"spec.gate.robots[{number}]", message, warning=True)


def _unreached(workload: str, *, named: bool) -> str:
    if named:
        return (
            f"the pod has the address of its node, and on Cilium, spec.gate.robots of RobotWorkload {workload} matches no node by default: "
            f"if the cluster has Cilium, {_SETTING}"
        )
    return (
        "the pod has the address of its node, which no podSelector of a NetworkPolicy matches, so the instances of RobotWorkload "
        f"{workload} do not reach it: set spec.gate.robots of the RobotWorkload to that address and, if the cluster has Cilium, {_SETTING}"
    )


def _is_robot(workload: Manifest, pod: Manifest, namespaces: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether a pod has the environment of a workload's robot, or is one of the peers that its gate names."""
    _, spec = gated_pods.pod(pod) or ("", None)
    if workload.together(pod) and mux_container.path(spec, names.robot_env(workload.name)):
        return True
    labels = gated_pods.pod_labels(pod)
    for peer in _peers(workload):
        of_namespace = peer.get("namespaceSelector")
        if of_namespace is None:
            is_there = workload.together(pod)
        else:
            known = {_NAME: pod.namespace} if pod.namespace else {}
            is_there = selectors.matches(of_namespace, {**namespaces.get(pod.namespace, {}), **known})
        if is_there and selectors.matches(peer.get("podSelector") or {}, labels):
            return True
    return False


def _peers(workload: Manifest) -> Iterator[Object]:
    """Yield the valid peers of a gate. Another check reports the others."""
    for one in items(workload.data, "spec", "gate", "peers"):
        try:
            yield GatePeer.model_validate(one).to_wire()
        except ValidationError:
            continue


def _node(manifest: Manifest) -> Object:
    """Return the addresses of a node that is among the files."""
    found = [
        {"type": "InternalIP", "address": at(one, "address")}
        for one in items(manifest.data, "status", "addresses")
        if at(one, "type") == "InternalIP"
    ]
    return {"metadata": {"name": manifest.name}, "status": {"addresses": found}}


def _matches_nodes(manifest: Manifest) -> bool:
    """Whether a manifest is Cilium's ConfigMap with the setting for robots in the network of a node."""
    if (manifest.kind, manifest.namespace, manifest.name) != ("ConfigMap", cilium.SYSTEM, cilium.SETTINGS):
        return False
    data = at(manifest.data, "data")
    return (
        isinstance(data, dict)
        and cilium.Settings.of({k: v for k, v in data.items() if isinstance(v, str)}).matches_nodes
    )
