"""The gate kind ``NetworkPolicy``: the gate object is a policy that lets the pod it selects send to the robot's gated ports.

Two policies make this gate, both on a workload's instances and never on the robot's pods. Policies add up, so the switch only patches the
selector of the gate object:

- ``W-standby`` selects every instance, and allows it to exchange everything with its peers except UDP to their gated ports. Only
  the workload's monitor reaches its agent's control channel.
- ``W-gate``, the gate object, selects the one instance in control, and allows it to send UDP to the gated ports of the same peers.

The peers are the monitor and the discovery server of the workload, and those of its :class:`Reach`, but no other instance of it. Other
policies may allow an instance more. Only if they include UDP to the gated ports, they open the gate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ipaddress import ip_address
from typing import Any

from understudy.api import names
from understudy.kube import selectors
from understudy.kube.client import NETWORK_POLICIES, Object, Resource
from understudy.kube.gates import pod_networks
from understudy.kube.gates.base import GateKind, Reach
from understudy.kube.gates.policy_parts import addresses, named, network_policy, of_workload, ports, protectors
from understudy.kube.gates.probes import ProbeKeys, ProbeReceiver

_DNS = (53, 5353)
"""Ports of DNS servers: the usual one, and that of the pods behind it in some distributions."""


class NetworkPolicyGate(GateKind):
    """Fences packets when they leave their pod. The cluster's network must enforce NetworkPolicies."""

    kind = object_kind = "NetworkPolicy"
    resource = NETWORK_POLICIES
    page = "docs/how-to/network-policies.md"

    def how_it_switches(self, workload: str) -> str:
        """Return that one write switches, and the network does the rest."""
        return (
            f"The gate is NetworkPolicy {names.gate(workload)}: one write to it switches, and the network enforces that on the nodes "
            "of both pods."
        )

    def words_for_admitted(self, standby: str) -> str:
        """Return that packets of the standby pass too."""
        return f"The gate also admits standby {standby} (spec.gate.reflex)."

    def routing(self, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the pod selector. They remove the labels of another one, also of an earlier version."""
        return {"spec": {"podSelector": {"matchLabels": None, **_selector(workload, active, admitted)}}}

    def let_through(self, gate: Object) -> tuple[str, ...]:
        """Return the names of the instances that the policy selects."""
        selector = gate["spec"].get("podSelector") or {}
        values = [(selector.get("matchLabels") or {}).get(names.INSTANCE)]  # of an earlier version
        for expression in selector.get("matchExpressions") or []:
            if (expression["key"], expression["operator"]) == (names.INSTANCE, "In"):
                values += expression["values"]
        return tuple(value for value in values if value and value != names.NOBODY)

    def routing_repair(self, gate: Object, workload: str, active: str, admitted: str = "") -> Object:
        """Return merge patch fields of the pod selector, without what somebody added to it; empty if the selector is right."""
        selector = gate["spec"].get("podSelector") or {}
        present = (selector.get("matchLabels") or {}, selector.get("matchExpressions") or [])
        right: tuple[Object, Object] = ({}, _selector(workload, active, admitted)["matchExpressions"])
        if present in (right, _of_earlier_versions(workload, active, admitted)):
            return {}
        return self.routing(workload, active, admitted)

    def ungateable(self, template: Mapping[str, Any]) -> str:
        """Return why no policy applies to such pods, or not on each of their interfaces; empty if policies do."""
        if (template.get("spec") or {}).get("hostNetwork"):
            return (
                "spec.hostNetwork is true: NetworkPolicies do not apply to a pod in its node's network, so its outputs cannot be gated. "
                "Set it to false"
            )
        annotations = (template.get("metadata") or {}).get("annotations") or {}
        if annotations.get(pod_networks.NETWORKS):
            return (
                f"metadata.annotations[{pod_networks.NETWORKS}] gives the pod further interfaces, and NetworkPolicies apply to that of "
                "the pod network only: a standby could reach the robot by another one. Remove it, and reach the robot by the pod network"
            )
        if annotations.get(pod_networks.DEFAULT_NETWORK):
            return (
                f"metadata.annotations[{pod_networks.DEFAULT_NETWORK}] connects the pod to another network instead of the pod network, "
                "and NetworkPolicies may not apply there: a standby could reach the robot by it. Remove it, and reach the robot by the "
                "pod network"
            )
        return ""

    def ungated(self, pod: Object) -> Mapping[str, tuple[str, ...]]:
        """Return the network of the pod's node if the pod uses it, and networks besides the pod network that annotations name."""
        return pod_networks.ungated(pod)

    def closed(self, workload: str, reach: Reach, *, epoch: int, fenced: int = 0) -> Object:
        """Return a policy that selects no pod."""
        policy = network_policy(names.gate(workload), _selector(workload), _gated(workload, reach))
        record = {names.EPOCH: str(epoch), names.ACTIVE: "", names.ACTIVE_UID: "", names.RECOVERY: ""}
        record |= {names.FENCED: str(fenced)} if fenced else {}
        policy["metadata"]["annotations"] = record
        return policy

    def spec_repair(self, gate: Object, workload: str, reach: Reach) -> Object:
        """Return merge patch fields that restore the rules of the policy."""
        spec, wanted = gate.get("spec") or {}, _gated(workload, reach)
        if all(spec.get(key) == value for key, value in wanted.items()) and not spec.get("ingress"):
            return {}
        return {"spec": {**wanted, "ingress": None}}

    def companions(self, workload: str, reach: Reach) -> list[tuple[Resource, Object]]:
        """Return the policies of every instance."""
        rules = self.instance_rules(workload, reach)
        found = [network_policy(names.standby(workload), {"matchLabels": {names.WORKLOAD: workload}}, rules)]
        if reach.reference:
            found.append(network_policy(names.standby_reference(workload), dict(reach.reference), rules))
        return [(NETWORK_POLICIES, policy) for policy in found]

    def instance_rules(self, workload: str, reach: Reach, pools: Sequence[str] = ()) -> Object:
        """Return rules that leave out the gated ports."""
        peers, first, last = _peers(workload, reach, pools), *names.GATE_RANGE
        ungated = [ports("TCP"), ports("UDP", 1, first - 1), ports("UDP", last + 1)]
        application = [ports("TCP", 1, names.AGENT_PORT - 1), ports("TCP", names.AGENT_PORT + 1), ports("UDP")]
        return {
            "policyTypes": ["Ingress", "Egress"],
            "ingress": [{"from": peers, "ports": application}, {"from": [protectors(workload)]}],
            "egress": [
                {"to": [*peers, protectors(workload)], "ports": ungated},
                {"ports": [{"protocol": protocol, "port": port} for protocol in ("UDP", "TCP") for port in _DNS]},
                *(
                    {"to": addresses([_single(host)]), "ports": [{"protocol": "TCP", "port": port}]}
                    for host, port in reach.apiservers
                ),
            ],
        }

    async def proof(self) -> ProbeReceiver:
        """Receive the datagrams that the agents send to a gated port of the monitor's pod, and that are authentic."""
        receiver = ProbeReceiver(ProbeKeys())
        await receiver.listen(port=names.PROBE_PORT)
        return receiver


def _selector(workload: str, active: str = "", admitted: str = "") -> Object:
    """Return the selector of the gate object. Nobody is admitted to a closed gate."""
    through = filter(None, (active, active and admitted))
    return {"matchExpressions": [of_workload(workload), named(through)]}


def _of_earlier_versions(workload: str, active: str, admitted: str) -> tuple[Object, list[Object]]:
    """Return labels and expressions that a monitor of an earlier version writes. It would restore them, so they count as right."""
    if active and admitted:
        return {names.WORKLOAD: workload}, [named([active, admitted])]
    return {names.WORKLOAD: workload, names.INSTANCE: active or names.NOBODY}, []


def _gated(workload: str, reach: Reach) -> Object:
    """Return the rules of the gate object: UDP to the gated ports of those whom the instances may reach."""
    first, last = names.GATE_RANGE
    to = [*_peers(workload, reach), protectors(workload)]
    return {"policyTypes": ["Egress"], "egress": [{"to": to, "ports": [ports("UDP", first, last)]}]}


def _peers(workload: str, reach: Reach, pools: Sequence[str] = ()) -> list[Object]:
    """Return the peers of the policies: those of the workload, but no instance of it.

    "No instance" means to lack the workload's label and not to match the selector of a referenced controller. A pod that was claimed
    lacks that label, so for such pods the others of their pools are left out too.
    """
    ours = [{"key": names.WORKLOAD, "operator": "NotIn", "values": [workload]}]
    if pools:
        ours.append({"key": names.POOL, "operator": "NotIn", "values": list(pools)})
    others: list[list[Object]] = [ours]
    if reach.reference:
        others = [[*ours, selectors.opposite(requirement)] for requirement in selectors.requirements(reach.reference)]
    found: list[Object] = []
    for peer in reach.peers or ({},):
        pods = peer.get("podSelector") or {}
        for expressions in others:
            selected = {**pods, "matchExpressions": [*(pods.get("matchExpressions") or []), *expressions]}
            found.append({**peer, "podSelector": selected})
    return found + addresses(reach.robots)


def _single(host: str) -> str:
    return f"{host}/{ip_address(host).max_prefixlen}"


GATE = NetworkPolicyGate()
