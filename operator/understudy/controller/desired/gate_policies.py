"""The network policies that decide whose outputs reach a robot, and those of held pods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.controller.observed import kube_objects, selectors
from understudy.kube.client import Object

_LAST_PORT = 65535


def closed_gate(workload: str, *, epoch: int) -> Object:
    """A gate through which nobody may send. Only made where there is none; from then on the monitor commits to it.

    ``epoch`` is the last one known, so that a gate that somebody deleted doesn't make older commits valid again.
    """
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {
            "name": names.gate(workload),
            "annotations": {names.EPOCH: str(epoch), names.ACTIVE: "", names.ACTIVE_UID: "", names.RECOVERY: ""},
        },
        "spec": {
            "podSelector": {"matchLabels": {names.WORKLOAD: workload, names.INSTANCE: names.GATE_CLOSED}},
            **_OPEN,
        },
    }


_OPEN: Object = {"policyTypes": ["Egress"], "egress": [{}]}


def gate_repair(gate: Object, *, owner: Object, labels: Mapping[str, str]) -> Object | None:
    """A merge patch that puts a gate's other parts right; its selector and annotations are the monitor's alone."""
    patch: Object = {}
    spec = gate.get("spec") or {}
    if spec.get("policyTypes") != _OPEN["policyTypes"] or spec.get("egress") != _OPEN["egress"] or spec.get("ingress"):
        patch["spec"] = {**_OPEN, "ingress": None}
    metadata: Object = {}
    lacking = {key: value for key, value in labels.items() if kube_objects.labels(gate).get(key) != value}
    if lacking:
        metadata["labels"] = lacking
    if owner not in (gate["metadata"].get("ownerReferences") or []):
        others = [o for o in gate["metadata"].get("ownerReferences") or [] if o.get("uid") != owner["uid"]]
        metadata["ownerReferences"] = [*others, owner]
    if metadata:
        patch["metadata"] = metadata
    return patch or None


def standby_policies(workload: str, robots: Sequence[str], reference: Mapping[str, Any] | None) -> list[Object]:
    """The policies under which all instances live: everything but each other and the robot's gated ports.

    ``reference`` is the selector of a referred controller: its pods are instances from birth, before they have labels
    of ours. So they are selected by it, and "not of this workload" means to lack the label and not to match the
    selector.
    """
    ours = {"key": names.WORKLOAD, "operator": "NotIn", "values": [workload]}
    ways: list[list[Object]] = (
        [[ours, selectors.opposite(requirement)] for requirement in selectors.requirements(reference)]
        if reference
        else [[ours]]
    )
    peers: list[Object] = [
        {"namespaceSelector": {}, "podSelector": {"matchExpressions": expressions}} for expressions in ways
    ]
    peers += [{"ipBlock": {"cidr": cidr}} for cidr in robots]
    first, last = names.GATE_RANGE
    ports = [
        {"protocol": "TCP", "port": 1, "endPort": _LAST_PORT},
        {"protocol": "UDP", "port": 1, "endPort": first - 1},
        {"protocol": "UDP", "port": last + 1, "endPort": _LAST_PORT},
    ]
    rules: Object = {
        "policyTypes": ["Ingress", "Egress"],
        "ingress": [{"from": peers}],
        "egress": [{"to": peers, "ports": ports}],
    }
    found = [_policy(names.standby(workload), {"matchLabels": {names.WORKLOAD: workload}}, rules)]
    if reference:
        found.append(_policy(names.standby_reference(workload), dict(reference), rules))
    return found


def held_policy(pool: str, claimable: str) -> Object:
    """The policy of unclaimed pods: they may be commanded and otherwise neither hear nor say anything.

    It also keeps, as an annotation, the hash of the template whose pods may be claimed.
    """
    agent = [{"protocol": "TCP", "port": port} for port in (names.AGENT_PORT, names.AGENT_HEALTH_PORT)]
    policy = _policy(
        names.held(pool),
        {"matchLabels": {names.POOL: pool, names.HELD: "true"}},
        {"policyTypes": ["Ingress", "Egress"], "ingress": [{"ports": agent}]},
    )
    policy["metadata"]["annotations"] = {names.TEMPLATE_HASH: claimable}
    return policy


def _policy(name: str, selector: Mapping[str, Any], rules: Object) -> Object:
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": name},
        "spec": {"podSelector": dict(selector), **rules},
    }
