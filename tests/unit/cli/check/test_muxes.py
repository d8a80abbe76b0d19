"""What the check says of workloads with a mux, and of the pods that run it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, checked, found, only

EXAMPLE = Path(__file__).parents[4] / "examples/quickstart/manifests"
DEPENDENT = EXAMPLE.parents[1] / "dependent"
ROBOT = (EXAMPLE / "mux/robot.yaml").read_text()
WORKLOAD = (EXAMPLE / "mux/robotworkload.yaml").read_text()
EXECUTING = (EXAMPLE / "strategies/executing.yaml").read_text()


def test_the_quickstart_with_a_mux_has_no_problem() -> None:
    assert checked(ROBOT, WORKLOAD, EXECUTING).findings == []


@pytest.mark.parametrize(
    ("line", "instead", "field", "fact"),
    [
        ("            - configMapRef: {name: robot-1-drive-robot-env}\n            - configMapRef: {name: robot-1-drive-mux}",
         "            - configMapRef: {name: robot-1-drive-mux}", "spec.template.spec.containers[1]", "robot-1-drive-robot-env"),
        ("            - {name: mux-token, mountPath: /etc/understudy-mux, readOnly: true}\n", "",
         "spec.template.spec.containers[1]", "/etc/understudy-mux"),
        ("secret: {secretName: robot-1-drive-mux}", "secret: {secretName: other}", "spec.template.spec.containers[1]",
         "Secret robot-1-drive-mux"),
        ("            - {name: mux-state, mountPath: /var/lib/understudy}\n", "", "spec.template.spec.containers[1]",
         "/var/lib/understudy"),
        ("  replicas: 1\n", "  replicas: 2\n", "spec.replicas", "these 2"),
        ("  strategy: {type: Recreate} # there is only one robot\n", "", "spec.strategy", "the new mux beside the old one"),
    ],
    ids=["graph", "mount", "secret", "state", "replicas", "strategy"],
)  # fmt: skip
def test_what_a_mux_lacks_in_its_pod_is_reported(line: str, instead: str, field: str, fact: str) -> None:
    assert line in ROBOT
    finding = only(ROBOT.replace(line, instead), WORKLOAD, EXECUTING)
    assert (finding.severity, finding.subject, finding.field) == ("warning", "Deployment robot-1", field)
    assert_golden("check", finding.message, fact)


@pytest.mark.parametrize(
    ("line", "fact"),
    [
        ("            - configMapRef: {name: robot-1-control-robot-env}\n          env:\n            - name: ROS_DISCOVERY_SERVER\n"
         "              valueFrom: {configMapKeyRef: {name: robot-1-localization-robot-env, key: ROS_DISCOVERY_SERVER}}\n"
         "          securityContext:", "robot-1-planning-robot-env"),
        ("              - secret: {name: robot-1-planning-mux}\n", "Secret robot-1-planning-mux"),
        ("            - {name: mux-state, mountPath: /var/lib/understudy}\n", "/var/lib/understudy"),
    ],
    ids=["graph", "secret", "state"],
)  # fmt: skip
def test_what_the_mux_of_several_workloads_lacks_is_reported_for_each(line: str, fact: str) -> None:
    workloads, robot = ((DEPENDENT / "mux" / name).read_text() for name in ("robotworkloads.yaml", "robot.yaml"))
    policies = (DEPENDENT / "manifests/policies.yaml").read_text()
    assert checked(robot, workloads, policies).findings == []
    assert line in robot
    instead = "            []\n          securityContext:" if line.endswith("securityContext:") else ""
    findings = checked(robot.replace(line, instead), workloads, policies).findings
    assert {(one.severity, one.subject, one.field) for one in findings} == {
        ("warning", "Deployment robot-1", "spec.template.spec.containers[1]")
    }
    assert any(fact in one.message for one in findings)


def test_a_workload_without_a_folder_in_the_mux_of_its_robot_is_reported() -> None:
    workloads, robot = ((DEPENDENT / "mux" / name).read_text() for name in ("robotworkloads.yaml", "robot.yaml"))
    mount = "            - {name: control, mountPath: /etc/understudy-mux/control, readOnly: true}\n"
    assert mount in robot
    finding = only(robot.replace(mount, ""), workloads, (DEPENDENT / "manifests/policies.yaml").read_text())
    assert (finding.severity, finding.subject) == ("warning", "RobotWorkload robot-1-control")


def test_a_robot_with_an_instance_on_board_needs_volumes_that_keep_its_environment() -> None:
    robot, workload = ((EXAMPLE / "mux/on-board" / name).read_text() for name in ("robot.yaml", "robotworkload.yaml"))
    assert checked(robot, workload, EXECUTING).findings == []
    line = "              - configMap: {name: robot-1-drive-mux}\n"
    assert line in robot
    finding = only(robot.replace(line, ""), workload, EXECUTING)
    assert (finding.severity, finding.field) == ("warning", "spec.template.spec.volumes")
    assert_golden("check", finding.message, "robot-1-drive-mux", "five minutes")


def test_a_robot_without_its_mux_is_reported() -> None:
    robot = ROBOT.replace("            - configMapRef: {name: robot-1-drive-mux}\n", "")
    finding = only(robot, WORKLOAD, EXECUTING)
    assert (finding.severity, finding.subject, finding.field) == (
        "warning",
        "RobotWorkload robot-1-drive",
        "spec.gate.kind",
    )
    assert_golden("check", finding.message, "robot-1-drive-mux")


def test_a_robot_elsewhere_may_have_its_mux_there() -> None:
    assert found(WORKLOAD, EXECUTING) == []


def test_a_mux_that_no_workload_has_is_reported() -> None:
    finding = only(ROBOT, WORKLOAD.replace("  gate: {kind: Mux}\n", ""), EXECUTING)
    assert (finding.severity, finding.field) == ("warning", "spec.template.spec.containers[1].envFrom")
    assert_golden("check", finding.message, "gate kind NetworkPolicy")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (("TwistStamped}", "TwistStamped, lifespan: 50ms}"), "spec.outputs[0].lifespan"),
        (("gate: {kind: Mux}", "gate: {kind: Mux, reflex: {accept: [/cmd_vel]}}"), "spec.gate.reflex.accept"),
    ],
)
def test_fields_that_have_no_effect_with_a_mux_are_reported(change: tuple[str, str], field: str) -> None:
    finding = only(WORKLOAD.replace(*change), EXECUTING)
    assert (finding.severity, finding.field) == ("warning", field)
    assert "has no effect with a mux" in finding.message


def test_workloads_whose_instances_no_mux_could_tell_apart_are_refused() -> None:
    referred = (
        POLICY
        + "---\n"
        + """\
apiVersion: understudy.dev/v1alpha1
kind: RobotWorkload
metadata: {name: robot-17}
spec:
  workloadRef: {kind: Deployment, name: nav2}
  gate: {kind: Mux}
  outputs:
    - {topic: /cmd_vel, type: geometry_msgs/msg/Twist}
  failurePolicyRef: {name: navigation}
"""
    )
    own = "          env: [{name: FASTRTPS_DEFAULT_PROFILES_FILE, value: /mine.xml}]\n          securityContext:"
    for text in (referred, EXECUTING + "---\n" + WORKLOAD.replace("          securityContext:", own)):
        finding = only(text)
        assert (finding.severity, finding.field) == ("error", "spec.gate.kind")
        assert "would reach the robot beside the mux" in finding.message


def test_a_pool_whose_pods_would_bypass_the_mux_is_reported() -> None:
    shared = (EXAMPLE / "strategies/uninitialized.yaml").read_text()
    workload = WORKLOAD.replace("quickstart-executing", "quickstart-uninitialized")
    assert found(workload, shared) == []
    env = "env: [{name: FASTRTPS_DEFAULT_PROFILES_FILE, value: /mine.xml}]"
    template = f"template: {{spec: {{containers: [{{name: drive, image: drive, command: [drive], {env}}}]}}}}"
    finding = only(workload, shared.replace("templateFrom: {workload: robot-1-drive}", template))
    assert (finding.severity, finding.field) == ("warning", "spec.template.spec.containers[0].env")
    assert "beside its mux" in finding.message
