"""A standby that keeps up, seen from the robot: what it was given while it waited is what it drives by when it takes over."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, never, patient
from tests.e2e.test_initialized import POOL, is_ready, standbys, wait_standing_by
from tests.e2e.test_strategies import assert_handed_over

APPLICATION = Path(__file__).with_name("knowing.py")

UNTOLD, FIRST, SECOND = 0.01, 0.02, 0.03
"""Speeds in metres per second: of the application that received none (see knowing.py), and the one that the robot publishes."""

PERIOD = 2
"""Seconds between two times at which a standby is given what is new."""

SAY = """
import sys, time, rclpy
from std_msgs.msg import Float32, String
rclpy.init()
node = rclpy.create_node("saying")
speed, note = node.create_publisher(Float32, "/speed", 10), node.create_publisher(String, "/note", 10)
end = time.monotonic() + 60
while not (speed.get_subscription_count() and note.get_subscription_count()) and time.monotonic() < end:
    time.sleep(0.1)
for _ in range(20):
    speed.publish(Float32(data=float(sys.argv[1])))
    note.publish(String(data="the door is open"))
    time.sleep(0.1)
"""
"""Run in the robot's pod: says a speed for two seconds, and never again."""


def application(workload: Object) -> None:
    """The workload drives at the speed that it received, and brings itself up."""
    spec = workload["spec"]["template"]["spec"]
    container = spec["containers"][0]
    container["command"] = ["python3", "/application/knowing.py"]
    container["volumeMounts"] = [{"name": "application", "mountPath": "/application"}]
    spec["volumes"] = [{"name": "application", "configMap": {"name": "application"}}]


def protection() -> list[Object]:
    """Speed and note are kept and given to standbys while they wait; at a failover the note alone is given."""
    policy, pool = patient(manifest("strategies/initialized.yaml"), "4s")
    policy["spec"]["state"] = {
        "keep": [
            {"topic": "/speed", "type": "std_msgs/msg/Float32", "restoreTo": "/told", "maxAge": "24h"},
            {"topic": "/note", "type": "std_msgs/msg/String", "restoreTo": "/noted", "maxAge": "24h"},
        ]
    }
    fallback = policy["spec"]["strategies"][0]
    fallback["recovery"] = {"within": "10s", "yaml": {"restore_state": {"only": ["/note"]}}}
    pool["spec"]["initialization"] = {"within": "60s", "yaml": {"wait_for": {"node": "/drive"}}}
    pool["spec"]["readinessCheck"] = {"period": "1s", "yaml": {"node_present": {"node": "/drive"}}}
    pool["spec"]["keepUp"] = {"period": f"{PERIOD}s"}
    return [policy, pool]


@pytest.fixture
def robot(kubectl: Kubectl, gate_kind: str) -> Robot:
    """A robot with an initialized standby that is kept up."""
    robot = Robot(kubectl, gate_kind=gate_kind)
    source = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "application"}}
    kubectl.apply([source | {"data": {APPLICATION.name: APPLICATION.read_text()}}, *protection()])
    kubectl.apply(robot.objects(policy=POOL, edit=application))
    robot.wait_protected()
    wait_standing_by(robot)
    return robot


def said_by(robot: Robot, pod: str) -> list[str]:
    """What the application in a pod has said."""
    return robot.kubectl("logs", pod, "-c", "drive").splitlines()


@pytest.mark.long
@pytest.mark.shows("step/restore_state", "step/wait_for", "condition/node_present", "readiness/Initialized")
def test_a_standby_receives_new_state_while_it_waits_and_uses_it_after_the_takeover(robot: Robot) -> None:
    old = robot.wait_protected()
    (standby,) = (pod["metadata"]["name"] for pod in standbys(robot) if is_ready(pod))
    for speed in (FIRST, SECOND):
        robot.kubectl.shell(robot.robot_pod(), "robot", 'python3 -c "$1" "$2"', SAY, str(speed))
        eventually(
            lambda speed=speed: f"told {speed:.2f}" in said_by(robot, standby),
            within=60,
            what=f"{standby} is told {speed} while it waits",
            note=robot.describe,
        )
    assert "noted the door is open" in said_by(robot, standby)
    assert not any(line.startswith("told") for line in said_by(robot, old)), "the instance in control is given nothing"
    never(robot.log().of(standby), "commands of the standby")
    assert not any(event["reason"] == "StandbyNotKeptUp" for event in robot.kubectl.list("events"))

    robot.fail(old, "deleted")
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.new) == ("Fallback/Initialized", standby), recovery
    became = robot.status()["recoveries"][0]["state"]
    assert {entry["name"] for entry in became if entry["restored"]} == {"/note"}, became
    assert_handed_over(robot, recovery)
    log = robot.log()
    assert {round(command.linear, 3) for command in log.of(old)} == {UNTOLD}
    assert {round(command.linear, 3) for command in log.of(standby)} == {SECOND}, "from its first command on"
