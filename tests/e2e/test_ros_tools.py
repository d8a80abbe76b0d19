"""What ROS tools in the robot's graph learn about a workload, read as they read it."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, patient

DIAGNOSES = """
import json, sys, time, rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
rclpy.init()
node = rclpy.create_node("reading")
def told(array):
    for s in array.status:
        if s.name != "lidar":
            values = {v.key: v.value for v in s.values}
            print(json.dumps([s.name, s.hardware_id, s.level[0], s.message, values]), flush=True)
node.create_subscription(DiagnosticArray, "/diagnostics", told, 10)
publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
lidar = DiagnosticArray(status=[DiagnosticStatus(name="lidar", level=DiagnosticStatus.OK)])
node.create_timer(0.5, lambda: publisher.publish(lidar))
end = time.monotonic() + float(sys.argv[1])
while time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
"""
"""Run in the robot's pod: prints every status for so many seconds. Meanwhile the robot has a lidar, which is well."""

SNAPSHOTS = """
import json, sys, time, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from py_trees_ros_interfaces.msg import BehaviourTree
from py_trees_ros_interfaces.srv import OpenSnapshotStream
rclpy.init()
node = rclpy.create_node("viewing")
client = node.create_client(OpenSnapshotStream, sys.argv[1] + "/snapshot_streams/open")
assert client.wait_for_service(30)
future = client.call_async(OpenSnapshotStream.Request())
rclpy.spin_until_future_complete(node, future, timeout_sec=30)
seen = []
node.create_subscription(BehaviourTree, future.result().topic_name, seen.append,
    QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
end = time.monotonic() + 30
while not seen and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps([[b.name, b.class_name, b.status, b.is_active] for b in seen[-1].behaviours]))
"""
"""Run in an image with py_trees_ros_interfaces: what a viewer does that finds the tree by its service."""

FOR = 300
"""Seconds for which statuses are read at most."""


class Told(NamedTuple):
    """A status as it was read."""

    name: str
    hardware: str
    level: int
    message: str
    values: dict[str, str]


class Reader:
    """Reads statuses in the robot's pod while other things happen."""

    def __init__(self, robot: Robot) -> None:
        self.told: list[Told] = []
        arguments = ("exec", robot.robot_pod(), "-c", "robot", "--", "python3", "-c", DIAGNOSES, str(FOR))
        self._process = subprocess.Popen(robot.kubectl.command(*arguments), stdout=subprocess.PIPE, text=True)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("["):
                self.told.append(Told(*json.loads(line)))

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join(10)


def told_of(kubectl: Kubectl, **monitor: Any) -> Robot:
    """A robot with an executing standby, whose monitor tells ROS tools."""
    robot = Robot(kubectl)

    def edit(item: Object) -> None:
        item["spec"]["monitor"] = monitor

    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    kubectl.apply(robot.objects(policy="quickstart-executing", edit=edit))
    robot.wait_protected()
    return robot


@pytest.fixture
def diagnosed(kubectl: Kubectl) -> Iterator[tuple[Robot, Reader]]:
    """A robot of which /diagnostics tells, and what is read there."""
    robot = told_of(kubectl, diagnostics=True)
    reader = Reader(robot)
    yield robot, reader
    reader.close()


@pytest.mark.long
def test_diagnostics_report_a_failover_with_its_reason_and_are_not_evidence(diagnosed: tuple[Robot, Reader]) -> None:
    robot, reader = diagnosed
    kubectl = robot.kubectl
    eventually(lambda: reader.told, within=60, what="a status is read", note=robot.describe)
    # The tree of the instance in control and of its standby hears the monitor's own ERROR from now on, beside the lidar.
    tree = kubectl.get("failurepolicy", "quickstart-executing")["spec"]["monitoring"]["yaml"]
    tree = {"parallel": [*tree["parallel"], {"diagnostics": {"worst": "OK"}}]}
    kubectl.patch("failurepolicy", "quickstart-executing", {"spec": {"monitoring": {"yaml": tree}}})
    eventually(
        lambda: "/diagnostics" in robot.condition("Monitored").get("message", ""),
        within=30,
        what="/diagnostics is watched",
        note=robot.describe,
    )
    old = robot.wait_protected()
    robot.wait_standby()
    robot.fail(old, "frozen")
    recovery = robot.wait_recovered(1)
    eventually(
        lambda: reader.told[-1].values["in control"] == recovery.new and reader.told[-1].level == 0,
        within=60,
        what="the new instance is told of",
        note=lambda: str(reader.told[-3:]),
    )
    assert {(told.name, told.hardware) for told in reader.told} == {
        (f"understudy: {robot.workload}", f"{kubectl.namespace}/{robot.workload}")
    }
    failed = next(told for told in reader.told if told.level == 2)
    assert "/cmd_vel" in failed.message
    assert (failed.values["in control"], failed.values["gate epoch"]) == (old, "1")
    last = reader.told[-1]
    assert last.message == f"{recovery.new} is in control"
    assert last.values["last recovery"] == "Recovered by Fallback/Executing"
    assert float(last.values["last recovery: took (s)"]) > 0
    assert last.values["leaf diagnostics"] == "Healthy"
    robot.wait_protected()
    assert len(robot.recoveries()) == 1, "what the monitor said itself was no failure"


def test_a_viewer_finds_the_tree_and_is_shown_it(kubectl: Kubectl) -> None:
    robot = told_of(kubectl, snapshots=True, image="localhost/understudy-navigation:dev")
    (monitor,) = (pod["metadata"]["name"] for pod in robot.monitor_pods())
    answer = kubectl.shell(
        monitor, "monitor", 'python3 -c "$1" "$2"', SNAPSHOTS, "/understudy/robot_1_drive", timeout=120
    )
    told = json.loads(next(line for line in answer.splitlines() if line.startswith("[[")))
    assert ["commands", "understudy.topic", 3, True] in told
    assert told[0][1] == "understudy.parallel"


@pytest.mark.long
def test_an_image_without_the_tree_s_message_package_is_reported(kubectl: Kubectl) -> None:
    robot = told_of(kubectl, snapshots=True)
    wanted = "involvedObject.kind=RobotWorkload,reason=TypeNotInstalled"
    eventually(
        lambda: (
            "spec.monitor.snapshots: py_trees_ros_interfaces/msg/BehaviourTree is not installed"
            in kubectl("get", "events", f"--field-selector={wanted}", "-o", "json")
        ),
        within=30,
        what="an Event tells it",
        note=robot.describe,
    )
    assert robot.condition("Healthy").get("status") == "True"
