"""Who reaches what: the peers of a workload's instances, and the network policy of its monitor and its discovery server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.controller.observed.observation import Observed
from understudy.kube.client import Object
from understudy.kube.gates.base import Reach
from understudy.kube.gates.policy_parts import addresses, network_policy, of_workload, ports, protectors

_INSTANCES: Object = {"podSelector": {"matchExpressions": [{"key": names.WORKLOAD, "operator": "Exists"}]}}
"""The instances of all workloads of the namespace, as a peer: only they have an agent that may be cut off.

Unclaimed pods have the label too, but can send nothing.
"""


def reach(observed: Observed, spec: RobotWorkloadSpec) -> Reach:
    """Return with whom the instances of a workload may exchange packets."""
    reference = None
    if observed.reference is not None and observed.reference.controller is not None:
        reference = observed.reference.controller["spec"]["selector"]
    peers = (peer.model_dump(by_alias=True, exclude_none=True) for peer in spec.gate.peers)
    return Reach(
        peers=tuple({key: _stored(selector) for key, selector in peer.items()} for peer in peers),
        robots=tuple(spec.gate.robots),
        reference=reference,
        apiservers=observed.apiservers,
    )


def policy(workload: str, within: Reach, metrics_from: Sequence[Object], *, from_nodes: bool = False) -> Object:
    """Return the policy of the monitor and the discovery server.

    Those whom the instances may reach discover the robot's graph and are observed, and the instances do so too. An agent that is cut off
    asks its monitor and other pods of the namespace whether they answer, by TCP at the port of the probes. These may be monitors of other
    workloads, so the instances of all workloads of the namespace may ask. ``metrics_from`` are the peers that read metrics.
    ``from_nodes`` is whether instances have the addresses of their nodes, which no policy can name: then everybody reaches the graph.
    """
    ours: list[Object] = [{"podSelector": {"matchExpressions": [of_workload(workload)]}}, protectors(workload)]
    ours += [{"podSelector": dict(within.reference)}] if within.reference else []
    peers = [*(within.peers or [{"podSelector": {}}]), *addresses(within.robots)]
    graph = [ports("UDP", last=names.PROBE_PORT - 1), ports("UDP", names.PROBE_PORT + 1)]
    ingress: list[Object] = [
        {"ports": graph} if from_nodes else {"from": [*peers, *ours], "ports": graph},
        {"from": ours, "ports": [ports("UDP", names.PROBE_PORT, names.PROBE_PORT)]},
        {"from": [_INSTANCES], "ports": [{"protocol": "TCP", "port": names.PROBE_PORT}]},
    ]
    if metrics_from:
        ingress.append({"from": list(metrics_from), "ports": [{"protocol": "TCP", "port": names.METRICS_PORT}]})
    return network_policy(
        names.control_plane(workload),
        {"matchLabels": {names.MONITORED: workload}},
        {"policyTypes": ["Ingress"], "ingress": ingress},
    )


def _stored(selector: Mapping[str, Any]) -> Object:
    """Return a selector as the API server stores it: without empty parts."""
    return {key: value for key, value in selector.items() if value}
