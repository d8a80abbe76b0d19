"""Who reaches the monitor and the discovery server of a workload, and which pods its instances reach."""

from __future__ import annotations

from typing import Any

from tests.unit.controller.world import World, applied, hot, policy, workload
from understudy.api import names
from understudy.controller.desired import control_plane_policies
from understudy.kube.client import Object
from understudy.kube.gates.base import Reach

OURS = [
    {"podSelector": {"matchExpressions": [{"key": names.WORKLOAD, "operator": "In", "values": ["w", ""]}]}},
    {"podSelector": {"matchLabels": {names.MONITORED: "w"}}},
]
NAMESPACE = {"podSelector": {}}
ROBOT = {"ipBlock": {"cidr": "192.168.7.4/32"}}


def _who(spec: Object, protocol: str, port: int) -> list[Any]:
    """The peers of the rules that include a port."""
    return [
        peer
        for rule in spec["ingress"]
        for one in rule["ports"]
        if one["protocol"] == protocol and one["port"] <= port <= one.get("endPort", one["port"])
        for peer in rule["from"]
    ]


def test_peers_and_instances_take_part_in_the_graph_and_only_instances_send_probes() -> None:
    spec = control_plane_policies.policy("w", Reach(robots=("192.168.7.4/32",)), ())["spec"]
    assert spec["podSelector"] == {"matchLabels": {names.MONITORED: "w"}}
    assert spec["policyTypes"] == ["Ingress"]
    assert _who(spec, "UDP", names.DISCOVERY_PORT) == [NAMESPACE, ROBOT, *OURS]
    assert _who(spec, "UDP", 7950) == [NAMESPACE, ROBOT, *OURS]
    assert _who(spec, "UDP", names.PROBE_PORT) == OURS


def test_instances_of_the_namespace_and_nobody_else_may_ask_a_monitor_whether_it_answers() -> None:
    spec = control_plane_policies.policy("w", Reach(peers=({"namespaceSelector": {}},)), ())["spec"]
    instances = {"matchExpressions": [{"key": names.WORKLOAD, "operator": "Exists"}]}
    assert _who(spec, "TCP", names.PROBE_PORT) == [{"podSelector": instances}]
    assert _who(spec, "UDP", names.DISCOVERY_PORT) == [{"namespaceSelector": {}}, *OURS]


def test_pods_of_a_reference_are_known_before_they_have_labels() -> None:
    spec = control_plane_policies.policy("w", Reach(reference={"matchLabels": {"app": "nav"}}), ())["spec"]
    assert _who(spec, "UDP", names.PROBE_PORT) == [*OURS, {"podSelector": {"matchLabels": {"app": "nav"}}}]


def test_metrics_are_for_those_whom_the_chart_names() -> None:
    prometheus = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}}
    for readers in ([], [prometheus]):
        spec = control_plane_policies.policy("w", Reach(), readers)["spec"]
        assert _who(spec, "TCP", names.METRICS_PORT) == readers
        assert _who(spec, "TCP", names.TASKS_PORT) == []


def test_a_workload_s_peers_are_those_of_its_spec_as_the_api_server_stores_them() -> None:
    peers = [{"namespaceSelector": {"matchLabels": {}}}, {"podSelector": {"matchLabels": {"app": "base"}}}]
    world = World(workload(gate={"peers": peers, "robots": ["10.0.0.0/24"]}), policy("hot"), hot())
    to = applied(world.plan(), "networkpolicies")["w-standby"]["spec"]["egress"][0]["to"]
    others = [{"key": names.WORKLOAD, "operator": "NotIn", "values": ["w"]}]
    assert to == [
        {"namespaceSelector": {}, "podSelector": {"matchExpressions": others}},
        {"podSelector": {"matchLabels": {"app": "base"}, "matchExpressions": others}},
        {"ipBlock": {"cidr": "10.0.0.0/24"}},
        {"podSelector": {"matchLabels": {names.MONITORED: "w"}}},
    ]
