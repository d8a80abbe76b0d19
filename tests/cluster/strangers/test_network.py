"""What the policies of a workload let through, by packets between pods: its instances, its monitor, a robot, and others."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cluster.policy_pods import Flow, World, flows
from tests.support.cluster import Object
from understudy.api import names
from understudy.controller.desired import control_plane_policies
from understudy.kube.gates.base import Reach
from understudy.kube.gates.kinds.network_policy import GATE

pytestmark = pytest.mark.xdist_group("network policies")  # one process starts the pods of the table

LABELS = {
    "active": {names.WORKLOAD: "w", names.INSTANCE: "active"},
    "standby": {names.WORKLOAD: "w", names.INSTANCE: "standby"},
    "camera": {names.MONITORED: "w", names.COMPONENT: "monitor"},
}
"""The pods of the table that play a part. ``camera`` is the monitor, ``robot`` is in the workload's namespace, ``dashboard`` in another."""

TOOLS = {"namespaceSelector": {"matchLabels": {"team": "operators"}}}

ROBOT = flows(["robot -> active udp/1000", "robot -> active tcp/80", "robot -> camera udp/11811"])
"""A robot's own packets: sensor data, and its introduction at the discovery server."""


@pytest.fixture(scope="module")
def workload(world: World) -> Iterator[World]:
    """The pods of the table with the labels of a workload's pods."""
    _label(world, LABELS)
    yield world
    _label(world, {pod: dict.fromkeys(labels) for pod, labels in LABELS.items()})


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


def _enforce(world: World, reach: Reach, *, metrics_from: list[Object] | None = None) -> None:
    """Apply the policies of the workload, with a gate that is open for the active instance."""
    gate = GATE.closed("w", reach, epoch=1)
    gate["spec"]["podSelector"]["matchLabels"][names.INSTANCE] = "active"
    found = [gate, *(body for _, body in GATE.companions("w", reach))]
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
                "robot -> camera tcp/8149",
                "active -> dashboard udp/53",
            ]
        ),
        flows(
            [
                "standby -> camera udp/8149",
                "robot -> camera udp/8149",
                "robot -> active tcp/8950",
                "dashboard -> active tcp/8950",
                "robot -> camera tcp/9108",
                "dashboard -> camera tcp/9108",
                "dashboard -> camera tcp/8149",
            ]
        ),
    )


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
