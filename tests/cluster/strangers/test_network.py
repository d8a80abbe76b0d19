"""What the policies of a workload let through, by packets between pods: its instances, its monitor, a robot, and others."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence

import pytest

from testcluster.local import layout as layouts
from testcluster.local import network, node
from tests.cluster.policy_pods import Agent, Flow, World, flows
from tests.support.cluster import Object
from understudy.api import names
from understudy.controller.desired import control_plane_policies
from understudy.kube.gates import pool_pod_policies
from understudy.kube.gates.base import Reach
from understudy.kube.gates.kinds.network_policy import GATE

pytestmark = pytest.mark.xdist_group("network policies")  # one process starts the pods of the table

LABELS = {
    "active": {names.WORKLOAD: "w", names.INSTANCE: "active"},
    "standby": {names.WORKLOAD: "w", names.INSTANCE: "standby"},
    "camera": {names.MONITORED: "w", names.COMPONENT: "monitor"},
    "distant": {names.WORKLOAD: "v", names.INSTANCE: "distant"},
}
"""The pods of the table that play a part. ``camera`` is the monitor, ``robot`` is in the workload's namespace, ``dashboard`` in another.
``distant`` is an instance of another workload of the namespace."""

HOSTS = {"metadata": "169.254.169.254", "internet": "203.0.113.7"}
"""Addresses that are neither those of pods nor of nodes: that of the metadata service of clouds, and one of an example (RFC 5737)."""

HOST_PORTS = (53, 80, 1000, 7950)
OPEN = ("tcp/80", "udp/1000")
DATA = (*OPEN, "udp/7950")
"""Those that are not for DNS: the last one is gated."""

TOOLS = {"namespaceSelector": {"matchLabels": {"team": "operators"}}}

ROBOT = flows(["robot -> active udp/1000", "robot -> active tcp/80", "robot -> camera udp/11811"])
"""A robot's own packets: sensor data, and its introduction at the discovery server."""


@pytest.fixture(scope="module")
def workload(world: World) -> Iterator[World]:
    """The pods of the table with the labels of a workload's pods."""
    _label(world, LABELS)
    yield world
    _label(world, {pod: dict.fromkeys(labels) for pod, labels in LABELS.items()})


@pytest.fixture(scope="module")
def hosts(workload: World) -> Iterator[World]:
    """The same pods, with the hosts of HOSTS behind the nodes' router, and ``node``, another node than that of the instances."""
    layout = layouts.load(os.environ.get("UNDERSTUDY_CLUSTER_NAME") or layouts.DEFAULT_NAME)
    assert layout is not None
    router = network.holder(layout)
    elsewhere = next(n for n in layout.nodes if layouts.node_name(n) != workload.pods["active"]["spec"]["nodeName"])
    places = {name: (address, router) for name, address in HOSTS.items()}
    places["node"] = layout.node_ip(elsewhere), node.init(layout, elsewhere)
    with contextlib.ExitStack() as stack:
        for name, (address, pid) in places.items():
            assert pid is not None
            inside = network.inside(pid)
            if name in HOSTS:
                subprocess.run([*inside, "ip", "addr", "replace", f"{address}/32", "dev", "lo"], check=True)
                stack.callback(subprocess.run, [*inside, "ip", "addr", "del", f"{address}/32", "dev", "lo"], check=True)
            stack.callback(Agent(name, [*inside, "env", f"ADDRESS={address}"], HOST_PORTS).close)
            workload.outside[name] = address
        yield workload
    workload.outside.clear()


@pytest.fixture
def powerless_pod(workload: World) -> str:
    """A pod of another namespace, without rights and without labels of Understudy."""
    return "dashboard"


@pytest.fixture
def compromised_standby(workload: World) -> str:
    """A standby whose application others control: it sends what it likes, from the network of its pod."""
    return "standby"


def _label(world: World, wanted: dict[str, dict[str, str]] | dict[str, dict[str, str | None]]) -> None:
    for pod, labels in wanted.items():
        live = {"apiVersion": "v1", "kind": "Pod", "metadata": world.pods[pod]["metadata"]}
        world.cluster.patch(live, {"metadata": {"labels": labels}})


@contextlib.contextmanager
def _relabelled(world: World, pod: str, labels: Mapping[str, str]) -> Iterator[None]:
    """Give a pod other labels of Understudy for the duration of the context."""
    before = LABELS.get(pod, {})
    _label(world, {pod: {**dict.fromkeys(before), **labels}})
    try:
        yield
    finally:
        _label(world, {pod: {**dict.fromkeys(labels), **before}})


def _enforce(
    world: World,
    reach: Reach,
    *,
    metrics_from: list[Object] | None = None,
    active: str = "active",
    further: Sequence[Object] = (),
) -> None:
    """Apply the policies of the workload, with a gate that is open for the active instance, and further policies."""
    gate = GATE.closed("w", reach, epoch=1)
    gate["spec"]["podSelector"] = {
        "matchExpressions": GATE.routing("w", active)["spec"]["podSelector"]["matchExpressions"]
    }
    found = [gate, *(body for _, body in GATE.companions("w", reach)), *further]
    found.append(control_plane_policies.policy("w", reach, metrics_from or []))
    for item in found:
        item["metadata"]["namespace"] = world.spaces["fleet"]
    world.enforce(found)


def _commands(target: str) -> list[Flow]:
    return flows([f"active -> {target} udp/7950", f"active -> {target} udp/8000"])


def _other_traffic(target: str) -> list[Flow]:
    return flows([f"{one} -> {target} {port}" for one in ("active", "standby") for port in ("udp/1000", "tcp/80")])


ALL_PORTS = [f"{protocol}/{port}" for protocol in ("udp", "tcp") for port in (80, 1000, 7950, 8149, 8950, 9108, 11811)]
"""Gated ports, those of agents, monitors, metrics and discovery servers, and any others."""


def test_a_pod_without_rights_reaches_no_process_of_a_workload(workload: World, powerless_pod: str) -> None:
    _enforce(workload, Reach())
    targets = ("active", "standby", "camera")
    workload.expect(ROBOT, flows([f"{powerless_pod} -> {target} {port}" for target in targets for port in ALL_PORTS]))


def test_a_compromised_standby_commands_no_robot_and_no_agent_and_sends_no_test_packets(
    workload: World, compromised_standby: str
) -> None:
    _enforce(workload, Reach())
    gated = [
        f"{compromised_standby} -> {target} udp/{port}" for target in ("robot", "camera") for port in (7950, 8000, 8149)
    ]
    outside = [f"{compromised_standby} -> dashboard {port}" for port in ALL_PORTS]
    workload.expect(
        [*ROBOT, *flows([f"{compromised_standby} -> robot udp/1000", f"{compromised_standby} -> camera udp/11811"])],
        flows(
            [*gated, *outside, f"{compromised_standby} -> active tcp/8950", f"{compromised_standby} -> camera tcp/9108"]
        ),
    )


def test_only_the_active_instance_commands_and_only_within_the_namespace(workload: World) -> None:
    _enforce(workload, Reach())
    workload.expect(
        [*_commands("robot"), *_other_traffic("robot"), *ROBOT],
        [
            *flows(["standby -> robot udp/7950", "standby -> robot udp/8000", "active -> standby tcp/80"]),
            *_commands("dashboard"),
            *_other_traffic("dashboard"),
            *flows(["dashboard -> active tcp/80", "dashboard -> standby udp/1000", "dashboard -> camera udp/11811"]),
        ],
    )


def test_the_monitor_reaches_agents_and_observes_who_passes_the_gate(workload: World) -> None:
    _enforce(workload, Reach())
    workload.expect(
        flows(
            [
                "camera -> active tcp/8950",
                "camera -> standby tcp/8950",
                "active -> camera udp/8149",
                "standby -> camera tcp/8149",
                "distant -> camera tcp/8149",
                "active -> dashboard udp/53",
            ]
        ),
        flows(
            [
                "standby -> camera udp/8149",
                "distant -> camera udp/8149",
                "robot -> camera udp/8149",
                "robot -> camera tcp/8149",
                "robot -> active tcp/8950",
                "dashboard -> active tcp/8950",
                "robot -> camera tcp/9108",
                "dashboard -> camera tcp/9108",
                "dashboard -> camera tcp/8149",
            ]
        ),
    )


def test_only_a_monitor_that_serves_a_workload_reaches_an_unclaimed_pod(workload: World) -> None:
    monitors = {names.COMPONENT: "monitor"}
    with (
        _relabelled(workload, "standby", {names.POOL: "spare", names.HELD: "true"}),
        _relabelled(workload, "robot", monitors),
    ):
        policy = pool_pod_policies.held_pods("spare", "1")
        policy["metadata"]["namespace"] = workload.spaces["fleet"]
        workload.enforce([policy])
        sends = [f"standby -> {target} {port}" for target in ("robot", "camera") for port in ("udp/1000", "tcp/80")]
        workload.expect(
            flows(["camera -> standby tcp/8950"]),
            flows([*sends, "robot -> standby tcp/8950", "distant -> standby tcp/8950", "camera -> standby tcp/80"]),
        )


@pytest.mark.parametrize("in_control", [False, True], ids=["standby", "in-control"])
def test_a_claimed_pod_has_the_packets_of_an_instance_by_its_labels_from_before_the_claim(
    workload: World, in_control: bool
) -> None:
    """For a network that reads changed labels late, it is still unclaimed, and behind the policy of unclaimed pods too."""
    unclaimed = {names.WORKLOAD: names.UNCLAIMED, names.HELD: "true", names.POOL: "spare", names.INSTANCE: "standby"}
    policies = [
        pool_pod_policies.held_pods("spare", "1"),
        pool_pod_policies.claimed_pods("w", GATE.instance_rules("w", Reach()), ["standby"]),
    ]
    gated = flows([f"standby -> {to}" for to in ("robot udp/7950", "camera udp/8149")])
    with _relabelled(workload, "standby", unclaimed):
        _enforce(workload, Reach(), active="standby" if in_control else "active", further=policies)
        workload.expect(
            [
                *flows([f"standby -> robot {port}" for port in OPEN]),
                *flows(["robot -> standby udp/1000", "camera -> standby tcp/8950", "standby -> camera udp/11811"]),
                *flows(["standby -> camera tcp/8149"]),
                *(gated if in_control else []),
            ],
            [*([] if in_control else gated), *flows(["standby -> dashboard udp/1000", "robot -> standby tcp/8950"])],
        )
        _enforce(workload, Reach(), further=policies[:1])
        workload.expect([], [*gated, *flows([f"standby -> robot {port}" for port in OPEN])])


@pytest.mark.local_only
def test_instances_reach_no_host_outside_of_the_pods_except_for_dns(hosts: World) -> None:
    """Neither the metadata service of a cloud, nor the Internet, nor a node."""
    sources = ("active", "standby")
    data = flows([f"{one} -> {to} {port}" for one in sources for to in hosts.outside for port in DATA])
    dns = flows([f"{one} -> {to} {port}" for one in sources for to in hosts.outside for port in ("udp/53", "tcp/53")])
    hosts.enforce([])
    hosts.expect([*data, *dns], [])
    _enforce(hosts, Reach())
    hosts.expect(dns, data)


@pytest.mark.local_only
def test_a_host_that_the_workload_names_as_its_robot_is_reached_and_no_other(hosts: World) -> None:
    _enforce(hosts, Reach(robots=(f"{HOSTS['internet']}/32",)))
    reached = ["active -> internet udp/7950", *(f"{o} -> internet {p}" for o in ("active", "standby") for p in OPEN)]
    others = [f"{one} -> {to} {port}" for one in ("active", "standby") for to in ("metadata", "node") for port in DATA]
    hosts.expect(flows(reached), flows(["standby -> internet udp/7950", *others]))


def test_peers_in_another_namespace_are_commanded_by_the_active_instance_only(workload: World) -> None:
    _enforce(workload, Reach(peers=(TOOLS,)))
    workload.expect(
        [*_commands("dashboard"), *_other_traffic("dashboard"), *flows(["dashboard -> camera udp/11811"])],
        [
            *flows(["standby -> dashboard udp/7950", "dashboard -> active tcp/8950", "dashboard -> camera tcp/9108"]),
            *_commands("robot"),
            *ROBOT,
        ],
    )


def test_metrics_are_for_those_who_are_named(workload: World) -> None:
    _enforce(workload, Reach(), metrics_from=[TOOLS])
    workload.expect(
        flows(["dashboard -> camera tcp/9108"]), flows(["robot -> camera tcp/9108", "active -> camera tcp/9108"])
    )


def test_a_policy_of_the_user_adds_to_what_instances_reach(workload: World) -> None:
    _enforce(workload, Reach())
    workload.cluster.create(
        {
            "apiVersion": "networking.k8s.io/v1",
            "kind": "NetworkPolicy",
            "metadata": {"name": "database", "namespace": workload.spaces["fleet"]},
            "spec": {
                "podSelector": {"matchLabels": {names.WORKLOAD: "w"}},
                "policyTypes": ["Egress"],
                "egress": [{"to": [TOOLS], "ports": [{"protocol": "TCP", "port": 80}]}],
            },
        }
    )
    workload.expect(
        flows(["active -> dashboard tcp/80", "standby -> dashboard tcp/80"]),
        [*_commands("dashboard"), *flows(["active -> dashboard udp/1000"])],
    )
