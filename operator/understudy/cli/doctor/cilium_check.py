"""Checks whether Cilium has room for the gates: past the limit of its policy maps, it lets everything through without a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from understudy.cli.common.cluster_access.kubectl_proxy import Api, Refused
from understudy.cli.doctor.findings import Finding
from understudy.controller.observed import kube_objects
from understudy.kube.client import CONFIG_MAPS, NETWORK_POLICIES, NODES, Object
from understudy.kube.gates import cilium, registry
from understudy.kube.gates.cilium import Settings
from understudy.kube.gates.policy_entries import Peers

_ROOM = "room in Cilium"


def check(api: Api, namespace: str, workloads: Sequence[Object]) -> Iterator[Finding]:
    """Yield a finding about the policy maps, and one about robots in the network of a node; nothing if the network is another one."""
    gated = [one for one in workloads if not registry.of(one).is_at_robot]
    try:
        identities = api.get(cilium.IDENTITIES.path(None))["items"] if gated else []
    except Refused:  # no Cilium, or the user may not see it
        return
    if not identities:
        return
    settings = _settings(api)
    if settings.doubt and settings != cilium.UNREADABLE:
        cure = f"set it to a number (65536 at most), or remove it: {cilium.PAGE}"
        yield Finding("settings of Cilium", "WARN", f"{settings.doubt}. {settings.entries} is assumed", cure)
    policies = {kube_objects.name(one): one for one in api.get(NETWORK_POLICIES.path(namespace))["items"]}
    yield from _room(policies, Peers(map(cilium.peer, identities)), namespace, gated, settings)
    yield from _nodes(api, gated, settings)


def _room(
    policies: Mapping[str, Object], peers: Peers, namespace: str, workloads: Sequence[Object], settings: Settings
) -> Iterator[Finding]:
    """Compare what the workload that needs the most entries needs with what there are."""
    uses = [
        (use, name)
        for name in map(kube_objects.name, workloads)
        if (use := cilium.policy_map_use(name, namespace, policies, peers, settings)) is not None
    ]
    if not uses:
        return
    most, worst = max(uses, key=lambda one: one[0].needed)
    used = (
        f"an instance of {worst} needs {most.needed} entries in Cilium's policy map, of {settings.entries}, and {most.each} for each "
        "further pod of its peers"
    )
    if most.is_exceeded:
        yield Finding(_ROOM, "FAIL", f"{used}: {most.consequence}", cilium.MORE_ROOM)
    elif most.is_low:
        passed = "Past the limit, Cilium no longer enforces changes, and reports nothing"
        yield Finding(_ROOM, "WARN", f"{used}. {passed}", cilium.MORE_ROOM)
    else:
        yield Finding(_ROOM, "OK", used)


def _nodes(api: Api, workloads: Sequence[Object], settings: Settings) -> Iterator[Finding]:
    """Report robots at the address of a node: Cilium's address blocks match no node by default."""
    if settings.matches_nodes:
        return
    try:
        nodes = api.get(NODES.path(None))["items"]
    except Refused:
        return
    for workload in workloads:
        robots = ((workload.get("spec") or {}).get("gate") or {}).get("robots") or []
        for address, node in cilium.at_nodes(robots, nodes):
            yield Finding(
                f"robot of {kube_objects.name(workload)}",
                "FAIL",
                f"spec.gate.robots includes {address}, the address of node {node}, and Cilium's address blocks match no node",
                f"set policy-cidr-match-mode: nodes in ConfigMap {cilium.SETTINGS}: {cilium.PAGE}",
            )


def _settings(api: Api) -> Settings:
    """Return Cilium's settings; the defaults if this user may not read them."""
    try:
        return Settings.of(api.get(CONFIG_MAPS.path(cilium.SYSTEM, cilium.SETTINGS)).get("data") or {})
    except Refused:
        return cilium.UNREADABLE
