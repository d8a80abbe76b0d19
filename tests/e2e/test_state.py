"""Kept state: taken of a healthy instance and of the robot, restored on the instance that takes over, or reported as not restored."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, shared_claim

STATE = {
    "keep": [
        {"topic": "/map", "type": "nav_msgs/msg/OccupancyGrid", "restoreTo": "/map", "maxAge": "24h"},
        {"topic": "/odom", "type": "nav_msgs/msg/Odometry", "restoreTo": "/nobody_listens"},
        {"topic": "/nobody_talks", "type": "std_msgs/msg/String", "restoreTo": "/map"},
        {"topic": "/note", "type": "std_msgs/msg/String", "maxAge": "24h"},
    ],
    "parameters": [{"node": "/drive", "names": ["use_sim_time"]}],
    "lifecycle": ["/drive"],
    "within": "5s",
}

SAY = """
import time, rclpy
from std_msgs.msg import String
rclpy.init()
publisher = rclpy.create_node("noting").create_publisher(String, "/note", 10)
end = time.monotonic() + 60
while not publisher.get_subscription_count() and time.monotonic() < end:
    time.sleep(0.1)
for _ in range(20):
    publisher.publish(String(data="the door is open"))
    time.sleep(0.1)
"""
"""Run in the robot's pod: says something for two seconds, and never again."""


@pytest.fixture
def keeping(kubectl: Kubectl, gate_kind: str) -> Robot:
    """A robot whose managed application is only restarted, with a policy that keeps state, and wrong things among it."""
    return keeper(kubectl, STATE, gate_kind)


def keeper(kubectl: Kubectl, state: Object, gate_kind: str) -> Robot:
    robot = Robot(kubectl, gate_kind=gate_kind)
    policy = manifest("strategies/restart.yaml")
    policy[0]["spec"]["state"] = state
    kubectl.apply(policy)
    kubectl.apply(robot.objects(policy="quickstart-restart", workload="managed/robotworkload.yaml"))
    robot.wait_protected()
    return robot


@pytest.fixture
def claim(kubectl: Kubectl, tmp_path: Path) -> Iterator[str]:
    """A PersistentVolumeClaim that every node of the local provider can mount: they all have this machine's files."""
    kubectl.apply(shared_claim(kubectl, "kept", tmp_path / "kept"))
    yield "kept"
    kubectl("delete", "persistentvolume", f"{kubectl.namespace}-kept", "--wait=false")


def kept(robot: Robot) -> dict[str, Object]:
    """What is kept and was taken, by kind and name."""
    found: list[Object] = robot.status().get("state") or []
    return {f"{entry['kind']} {entry['name']}": entry for entry in found if entry.get("takenAt")}


def wait_kept(robot: Robot, *names: str) -> None:
    """Wait until all this was taken."""
    eventually(lambda: set(names) <= set(kept(robot)), within=90, what=f"{names} are kept", note=robot.describe)


def test_state_is_kept_and_restored_and_missing_state_is_reported(keeping: Robot) -> None:
    wait_kept(keeping, "Topic /map", "Topic /odom", "Parameters /drive", "Lifecycle /drive")
    assert kept(keeping)["Topic /map"]["bytes"] > 1000

    def missing() -> bool:
        condition = keeping.condition("StateKept")
        return condition.get("status") == "False" and "/nobody_talks: nobody publishes it" in condition["message"]

    eventually(missing, within=60, what="the topic that never comes is told", note=keeping.describe)
    wide = keeping.kubectl("get", "robotworkload", keeping.workload, "-o", "wide")
    assert "/map" in wide

    keeping.fail(keeping.wait_driven(), "deleted")
    keeping.wait_recovered(1)
    became = {entry["name"]: entry for entry in keeping.status()["recoveries"][0]["state"]}
    given = {name for name, entry in became.items() if entry["restored"]}
    assert given == {"/map", "/drive (parameters)", "/drive (lifecycle)"}, became
    assert became["/map"]["ageSeconds"] > 0
    assert "nobody subscribes to /nobody_listens" in became["/odom"]["message"], became
    assert "nobody publishes it" in became["/nobody_talks"]["message"], became
    condition = keeping.condition("StateRestored")
    assert (condition["status"], condition["reason"]) == ("False", "NotRestored"), condition
    assert "nobody subscribes to /nobody_listens" in condition["message"]
    assert any(event["reason"] == "StateNotRestored" for event in keeping.kubectl.list("events"))


@pytest.mark.long
def test_kept_state_outlasts_the_monitors_container(keeping: Robot) -> None:
    keeping.kubectl.shell(keeping.robot_pod(), "robot", 'python3 -c "$1"', SAY)
    wait_kept(keeping, "Topic /note", "Topic /map")
    before, restarts = kept(keeping)["Topic /note"], keeping.monitor_restarts()
    monitor = next(pod["metadata"]["name"] for pod in keeping.monitor_pods())
    keeping.kubectl.shell(monitor, "monitor", "sleep 3; kill -TERM 1")  # it is written every second

    eventually(
        lambda: keeping.monitor_restarts() > restarts,
        within=60,
        what="the monitor's container is restarted",
        note=keeping.describe,
    )
    # Only the next monitor publishes ages again.
    eventually(
        lambda: any(line.count("watching") for line in keeping.kubectl("logs", monitor, "-c", "monitor").splitlines()),
        within=60,
        what="the next monitor watches",
        note=keeping.describe,
    )
    keeping.wait_protected()
    wait_kept(keeping, "Topic /note", "Topic /map", "Lifecycle /drive")
    # Nobody has said it again. It was said for two seconds, and the first of them may be an earlier one.
    was, taken = (datetime.fromisoformat(entry["takenAt"]) for entry in (before, kept(keeping)["Topic /note"]))
    assert was <= taken <= was + timedelta(seconds=10)


@pytest.mark.alone  # cordons a node
@pytest.mark.local_only
@pytest.mark.long
def test_kept_state_outlasts_the_monitors_pod_and_its_node_with_a_claim(
    kubectl: Kubectl, claim: str, gate_kind: str
) -> None:
    robot = keeper(kubectl, STATE | {"storage": {"claimName": claim}}, gate_kind)
    kubectl.shell(robot.robot_pod(), "robot", 'python3 -c "$1"', SAY)
    wait_kept(robot, "Topic /note", "Topic /map")
    before = kept(robot)["Topic /note"]
    time.sleep(3)  # it is written every second
    (pod,) = robot.monitor_pods()
    node = pod["spec"]["nodeName"]
    kubectl("cordon", node)
    try:
        robot.replace_monitor()
    finally:
        kubectl("uncordon", node)
    (pod,) = (pod for pod in robot.monitor_pods() if not pod["metadata"].get("deletionTimestamp"))
    assert pod["spec"]["nodeName"] != node, "the next monitor is on another node"

    wait_kept(robot, "Topic /note", "Topic /map")
    was, taken = (datetime.fromisoformat(entry["takenAt"]) for entry in (before, kept(robot)["Topic /note"]))
    assert was <= taken <= was + timedelta(seconds=10), "nobody has said it again"

    old = robot.wait_protected()
    robot.fail(old, "deleted")
    robot.wait_recovered(1)
    became = {entry["name"]: entry for entry in robot.status()["recoveries"][0]["state"]}
    assert became["/map"]["restored"], became
    assert robot.wait_driven() != old
