"""Checks whether Cilium has room for the gates: past the limit of its policy maps, it lets everything through without a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from ipaddress import ip_address, ip_network

from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.doctor.findings import Finding
from understudy.controller.observed import kube_objects
from understudy.kube.client import CONFIG_MAPS, NETWORK_POLICIES, NODES, Object, Resource
from understudy.kube.gates import registry
from understudy.kube.gates.policy_entries import Peer, needed_for_each

IDENTITIES = Resource("cilium.io", "v2", "ciliumidentities")
_SYSTEM, _SETTINGS = "kube-system", "cilium-config"

ENTRIES = 16384
"""Entries of the policy map of a pod, unless ``bpf-policy-map-max`` is set."""

FULL = 0.7
"""Share of the entries above which a warning is due: identities that nobody uses any more count for up to half an hour."""

_PREFIX, _NAMESPACE = "k8s:", "k8s:io.kubernetes.pod.namespace"
OF_NAMESPACE = "k8s:io.cilium.k8s.namespace.labels."
"""How labels of an identity begin that are those of its namespace."""

PAGE = "docs/how-to/network-policies.md#cilium"


def check(api: Api, namespace: str, workloads: Sequence[Object]) -> Iterator[Finding]:
    """Yield a finding about the policy maps, and one about robots in the network of a node; nothing if the network is another one."""
    gated = [one for one in workloads if not registry.of(one).is_at_robot]
    try:
        identities = api.get(IDENTITIES.path(None))["items"] if gated else []
    except Refused:  # no Cilium, or the user may not see it
        return
    if not identities:
        return
    settings = _settings(api)
    peers = [_peer(one.get("security-labels") or {}) for one in identities]
    policies = {kube_objects.name(one): one for one in api.get(NETWORK_POLICIES.path(namespace))["items"]}
    yield from _room(policies, peers, namespace, gated, settings)
    yield from _nodes(api, gated, settings)


def _room(
    policies: Mapping[str, Object],
    peers: Sequence[Peer],
    namespace: str,
    workloads: Sequence[Object],
    settings: Mapping[str, str],
) -> Iterator[Finding]:
    """Compare what the workload that needs the most entries needs with what there are."""
    most, each, worst = 0, 0, ""
    for workload in workloads:
        name = kube_objects.name(workload)
        own = (names.standby(name), names.standby_reference(name), names.gate(name))
        entries = needed_for_each([policies[one] for one in own if one in policies], peers, namespace)
        if sum(entries) > most:
            most, each, worst = sum(entries), max(entries), name
    if not most:
        return
    there = int(settings.get("bpf-policy-map-max", ENTRIES))
    used = f"an instance of {worst} needs {most} entries in Cilium's policy map, of {there}, and {each} for each further pod of its peers"
    cure = (
        "let spec.gate.peers select the robot's pods only, put robots into namespaces of their own, or set bpf-policy-map-max (65536 at "
        f"most) in ConfigMap {_SETTINGS}: {PAGE}"
    )
    if most > there:
        closes = settings.get("enable-endpoint-lockdown-on-policy-overflow", "false") == "true"
        what = (
            "it closes the gate of everybody"
            if closes
            else "it no longer enforces changes, so several instances may drive a robot"
        )
        yield Finding("room in Cilium", "FAIL", f"{used}: {what}", cure)
    elif most > FULL * there:
        yield Finding(
            "room in Cilium",
            "WARN",
            f"{used}. Past the limit, Cilium no longer enforces changes, and reports nothing",
            cure,
        )
    else:
        yield Finding("room in Cilium", "OK", used)


def _nodes(api: Api, workloads: Sequence[Object], settings: Mapping[str, str]) -> Iterator[Finding]:
    """Report robots at the address of a node: Cilium's address blocks match no node by default."""
    if "nodes" in settings.get("policy-cidr-match-mode", ""):
        return
    try:
        nodes = api.get(NODES.path(None))["items"]
    except Refused:
        return
    of_nodes = {
        one["address"]: kube_objects.name(node)
        for node in nodes
        for one in (node.get("status") or {}).get("addresses") or []
        if one.get("type") == "InternalIP"
    }
    for workload in workloads:
        robots = ((workload.get("spec") or {}).get("gate") or {}).get("robots") or []
        networks = [ip_network(one, strict=False) for one in robots]
        for address, node in of_nodes.items():
            if any(ip_address(address) in network for network in networks):
                yield Finding(
                    f"robot of {kube_objects.name(workload)}",
                    "FAIL",
                    f"spec.gate.robots includes {address}, the address of node {node}, and Cilium's address blocks match no node",
                    f"set policy-cidr-match-mode: nodes in ConfigMap {_SETTINGS}: {PAGE}",
                )


def _settings(api: Api) -> Mapping[str, str]:
    """Return Cilium's settings; none if this user may not read them."""
    try:
        found: Mapping[str, str] = api.get(CONFIG_MAPS.path(_SYSTEM, _SETTINGS)).get("data") or {}
    except Refused:
        return {}
    return found


def _peer(labels: Mapping[str, str]) -> Peer:
    """Return the pods of an identity, by its labels."""
    own = {key: value for key, value in labels.items() if key != _NAMESPACE and not key.startswith("k8s:io.cilium.")}
    return Peer(
        labels.get(_NAMESPACE, ""),
        {key.removeprefix(_PREFIX): value for key, value in own.items()},
        {key.removeprefix(OF_NAMESPACE): value for key, value in labels.items() if key.startswith(OF_NAMESPACE)},
    )
