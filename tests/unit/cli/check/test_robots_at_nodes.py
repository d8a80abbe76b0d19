"""What the check says of robots in the network of a node, which no podSelector matches and, on Cilium, no address block."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, WORKLOAD, found, only, text

GATED = f"{WORKLOAD}  gate: {{robots: [192.168.7.0/24, 10.0.0.0/24]}}\n"
MUXED = f"{WORKLOAD}  gate: {{kind: Mux, robots: [10.0.0.7/32]}}\n"
NODES = text("""\
    apiVersion: v1
    kind: List
    items:
      - apiVersion: v1
        kind: Node
        metadata: {name: node1}
        status:
          addresses:
            - {type: InternalIP, address: 10.0.0.7}
            - {type: Hostname, address: node1}
    """)
ROBOT = text("""\
    apiVersion: apps/v1
    kind: Deployment
    metadata: {name: driver}
    spec:
      template:
        metadata: {labels: {app: driver}}
        spec:
          hostNetwork: true
          containers:
            - name: driver
              envFrom: [{configMapRef: {name: robot-17-robot-env}}]
    """)
SETTINGS = text("""\
    apiVersion: v1
    kind: ConfigMap
    metadata: {name: cilium-config, namespace: kube-system}
    data: {policy-cidr-match-mode: nodes}
    """)


def test_a_robot_at_the_address_of_a_node_among_the_files_is_reported() -> None:
    finding = only(POLICY, GATED, NODES)
    assert (finding.severity, finding.subject, finding.field) == (
        "warning",
        "RobotWorkload robot-17",
        "spec.gate.robots[1]",
    )
    assert_golden("check", finding.message, "10.0.0.7", "node1", "policy-cidr-match-mode")


def test_a_robot_in_the_network_of_its_node_is_reported() -> None:
    finding = only(POLICY, GATED, ROBOT)
    assert (finding.severity, finding.subject, finding.field) == (
        "warning",
        "Deployment driver",
        "spec.template.spec.hostNetwork",
    )
    assert_golden("check", finding.message, "RobotWorkload robot-17", "policy-cidr-match-mode")


def test_a_robot_in_the_network_of_its_node_whose_address_no_gate_names_is_reported_for_every_network() -> None:
    finding = only(POLICY, WORKLOAD, ROBOT)
    assert finding.field == "spec.template.spec.hostNetwork"
    assert_golden("check", finding.message, "RobotWorkload robot-17", "set spec.gate.robots")


@pytest.mark.parametrize(
    ("peer", "count"),
    [
        ("{podSelector: {matchLabels: {app: driver}}}", 1),
        ("{podSelector: {matchLabels: {app: other}}}", 0),
        ("{podSelector: {}}", 1),
        ("{namespaceSelector: {matchLabels: {kubernetes.io/metadata.name: robots}}}", 1),
        ("{namespaceSelector: {matchLabels: {kubernetes.io/metadata.name: fleet}}}", 0),
    ],
)
def test_a_pod_in_the_network_of_its_node_that_a_peer_selects_is_reported(peer: str, count: int) -> None:
    robot = ROBOT.replace("robot-17-robot-env", "other").replace("name: driver}", "name: driver, namespace: robots}", 1)
    gated = f"{WORKLOAD}  gate: {{robots: [10.0.0.7/32], peers: [{peer}]}}\n"
    assert [one.subject for one in found(POLICY, gated, robot)] == ["Deployment driver"] * count


def test_a_pod_of_another_namespace_is_no_peer_without_a_selector_for_namespaces() -> None:
    robot = ROBOT.replace("robot-17-robot-env", "other").replace("name: driver}", "name: driver, namespace: robots}", 1)
    gated = f"{WORKLOAD}  gate: {{robots: [10.0.0.7/32], peers: [{{podSelector: {{}}}}]}}\n"
    assert found(POLICY, gated.replace("name: robot-17,", "name: robot-17, namespace: fleet,"), robot) == []


@pytest.mark.parametrize(
    "files",
    [
        (GATED, NODES, ROBOT, SETTINGS),
        (GATED, NODES.replace("10.0.0.7", "10.0.1.7")),
        (GATED, ROBOT.replace("hostNetwork: true", "hostNetwork: false")),
        (GATED, ROBOT.replace("robot-17-robot-env", "robot-18-robot-env")),
    ],
    ids=["setting", "another address", "pod network", "of another workload"],
)
def test_nothing_is_reported_of_a_robot_that_is_reached(files: tuple[str, ...]) -> None:
    assert found(POLICY, *files) == []


def test_a_mux_needs_no_address_that_policies_match() -> None:
    assert "spec.gate.robots[0]" not in {one.field for one in found(POLICY, MUXED, NODES)}


def test_the_files_may_have_any_content() -> None:
    for part in ("labels: 7", "labels: {app: [driver]}"):
        assert found(POLICY, GATED, ROBOT.replace("labels: {app: driver}", part))
    for status in ("7", "{addresses: [7, {type: InternalIP, address: [10.0.0.7]}, {type: InternalIP, address: x}]}"):
        node = f"apiVersion: v1\nkind: Node\nmetadata: {{name: n}}\nstatus: {status}\n"
        assert found(POLICY, GATED, node) == []
    assert found(POLICY, GATED.replace("10.0.0.0/24", "7"), NODES)
    peers = "peers: [7, {podSelector: {matchExpressions: [7]}}]"
    assert found(POLICY, GATED.replace("robots:", f"{peers}, robots:"), ROBOT)
    assert found(POLICY, GATED, ROBOT, SETTINGS.replace("{policy-cidr-match-mode: nodes}", "7"))
