"""The gate kind ``NetworkPolicy``: the gate object is a policy that lets the pod it selects send to the robot's gated ports.

Two policies make this gate, both on a workload's instances and never on the robot's pods. Policies add up, so the switch only patches the
selector of the gate object:

- ``W-standby`` selects every instance, and allows all traffic with pods of other workloads except UDP to the gated ports.
- ``W-gate``, the gate object, selects the one instance in control, and allows all that it sends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.kube import selectors
from understudy.kube.client import NETWORK_POLICIES, Object, Resource
from understudy.kube.gates.base import GateKind
from understudy.kube.gates.probes import ProbeReceiver
from understudy.kube.gates.unclaimed_pod_policy import network_policy

_LAST_PORT = 65535

_NETWORKS = "k8s.v1.cni.cncf.io/networks"
"""The annotation with which Multus and similar network plugins give a pod further interfaces."""

_OPEN: Object = {"policyTypes": ["Egress"], "egress": [{}]}


class NetworkPolicyGate(GateKind):
    """Fences packets when they leave their pod. The cluster's network must enforce NetworkPolicies."""

    kind = object_kind = "NetworkPolicy"
    resource = NETWORK_POLICIES

    def routing(self, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the pod selector. Each of its two forms removes the other."""
        if active and admitted:
            among = {"key": names.INSTANCE, "operator": "In", "values": [active, admitted]}
            labels = {names.WORKLOAD: workload, names.INSTANCE: None}
            return {"spec": {"podSelector": {"matchLabels": labels, "matchExpressions": [among]}}}
        labels = {names.WORKLOAD: workload, names.INSTANCE: active or names.GATE_CLOSED}
        return {"spec": {"podSelector": {"matchLabels": labels, "matchExpressions": None}}}

    def let_through(self, gate: Object) -> tuple[str, ...]:
        """Return the names of the instances that the policy selects."""
        selector = gate["spec"].get("podSelector") or {}
        values = [(selector.get("matchLabels") or {}).get(names.INSTANCE)]
        for expression in selector.get("matchExpressions") or []:
            if (expression["key"], expression["operator"]) == (names.INSTANCE, "In"):
                values += expression["values"]
        return tuple(value for value in values if value and value != names.GATE_CLOSED)

    def routing_repair(self, gate: Object, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the pod selector, without what somebody added to it; empty if the selector is right."""
        selector = gate["spec"].get("podSelector") or {}
        wanted: Object = self.routing(workload, active, admitted)["spec"]["podSelector"]
        labels = {key: value for key, value in wanted["matchLabels"].items() if value}
        present = (selector.get("matchLabels") or {}, selector.get("matchExpressions") or None)
        if present == (labels, wanted["matchExpressions"]):
            return {}
        return {"spec": {"podSelector": wanted | {"matchLabels": dict.fromkeys(present[0]) | labels}}}

    def ungateable(self, template: Mapping[str, Any]) -> str:
        """Return why no policy applies to such pods, or not on each of their interfaces; empty if policies do."""
        if (template.get("spec") or {}).get("hostNetwork"):
            return (
                "spec.hostNetwork is true: NetworkPolicies do not apply to a pod in its node's network, so its outputs cannot be gated. "
                "Set it to false"
            )
        if ((template.get("metadata") or {}).get("annotations") or {}).get(_NETWORKS):
            return (
                f"metadata.annotations[{_NETWORKS}] gives the pod further interfaces, and NetworkPolicies apply to that of the pod "
                "network only: a standby could reach the robot by another one. Remove it, and reach the robot by the pod network"
            )
        return ""

    def closed(self, workload: str, *, epoch: int, fenced: int = 0) -> Object:
        """Return a policy that selects no pod."""
        selector = {"matchLabels": {names.WORKLOAD: workload, names.INSTANCE: names.GATE_CLOSED}}
        policy = network_policy(names.gate(workload), selector, _OPEN)
        record = {names.EPOCH: str(epoch), names.ACTIVE: "", names.ACTIVE_UID: "", names.RECOVERY: ""}
        record |= {names.FENCED: str(fenced)} if fenced else {}
        policy["metadata"]["annotations"] = record
        return policy

    def spec_repair(self, gate: Object) -> Object:
        """Return merge patch fields that restore the rules of the policy."""
        spec = gate.get("spec") or {}
        if all(spec.get(key) == value for key, value in _OPEN.items()) and not spec.get("ingress"):
            return {}
        return {"spec": {**_OPEN, "ingress": None}}

    def companions(
        self, workload: str, robots: Sequence[str], reference: Mapping[str, Any] | None
    ) -> list[tuple[Resource, Object]]:
        """Return the policies of every instance: they allow all traffic except with each other and to the robot's gated ports.

        "Not of this workload" means to lack its label and not to match the selector of a referenced controller.
        """
        ours = {"key": names.WORKLOAD, "operator": "NotIn", "values": [workload]}
        others: list[list[Object]] = (
            [[ours, selectors.opposite(requirement)] for requirement in selectors.requirements(reference)]
            if reference
            else [[ours]]
        )
        peers: list[Object] = [
            {"namespaceSelector": {}, "podSelector": {"matchExpressions": expressions}} for expressions in others
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
        found = [network_policy(names.standby(workload), {"matchLabels": {names.WORKLOAD: workload}}, rules)]
        if reference:
            found.append(network_policy(names.standby_reference(workload), dict(reference), rules))
        return [(NETWORK_POLICIES, policy) for policy in found]

    async def proof(self) -> ProbeReceiver:
        """Receive the datagrams that the agents send to a gated port of the monitor's pod."""
        receiver = ProbeReceiver()
        await receiver.listen(port=names.PROBE_PORT)
        return receiver


GATE = NetworkPolicyGate()
