"""An action that the robot serves: the goals of the instance in control arrive there, and no others."""

from __future__ import annotations

import hashlib
import json
from itertools import groupby
from pathlib import Path

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import CONTAINER, SIGNAL, Robot, eventually, manifest, never, patient
from tests.e2e.test_strategies import assert_handed_over
from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import REQUEST_LIFESPAN

APPLICATION = Path(__file__).parent / "applications" / "gripping.py"
ACTION: Object = {"action": "/grip", "type": "test_msgs/action/Fibonacci"}
GRIPPER = "gripper"

ENOUGH = 4
"""Goals of one instance, of which it sends two in a second."""

BUSY = 1.0
"""Seconds that a goal may outlive its lifespan on a busy machine."""


class Gripping(Robot):
    """A robot with a gripper, and an application that sends goals to it."""

    def with_gripper(self, policy: str) -> list[Object]:
        """Return the manifests of the robot and its workload."""
        mount = {"name": "application", "mountPath": "/application"}
        volume = {"name": "application", "configMap": {"name": "application"}}

        def edit(workload: Object) -> None:
            spec = workload["spec"]
            spec["outputs"].append(ACTION)
            pod = spec["template"]["spec"]
            (container,) = pod["containers"]
            container |= {"command": ["python3", "/application/gripping.py", "application"], "volumeMounts": [mount]}
            pod["volumes"] = [volume]

        found = self.objects(policy=policy, edit=edit)
        pod = next(item for item in found if item["kind"] == "Deployment")["spec"]["template"]["spec"]
        robot = next(one for one in pod["containers"] if one["name"] == "robot")
        mounts = [mount, *(one for one in robot["volumeMounts"] if one["name"] != "log")]
        command = ["python3", "/application/gripping.py", GRIPPER]
        pod["containers"].append(robot | {"name": GRIPPER, "command": command, "env": [], "volumeMounts": mounts})
        pod["volumes"].append(volume)
        source = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "application"}}
        return [source | {"data": {APPLICATION.name: APPLICATION.read_text()}}, *found]

    def freeze(self, pod: str) -> None:
        """Stop the application's process in a pod."""
        self.kubectl.kill(pod, "sh", "-c", SIGNAL, "sh", "STOP", APPLICATION.name, container=CONTAINER)

    def goals(self, pod: str = "") -> list[Object]:
        """Return the goals that the gripper received, of one pod or of all."""
        lines = self.kubectl("logs", self.robot_pod(), "-c", GRIPPER).splitlines()
        found = [json.loads(line) for line in lines if line.startswith("{")]
        return [one for one in found if not pod or one["sender"] == sender(pod)]

    def wait_goals(self, pod: str) -> None:
        """Wait until goals of a pod have arrived."""
        eventually(lambda: len(self.goals(pod)) >= ENOUGH, within=30, what=f"goals of {pod} arrive", note=self.describe)


def sender(pod: str) -> str:
    """Return what a goal's id contains of its sender's name (applications/gripping.py, which can be imported only with ROS)."""
    return hashlib.sha256(pod.encode()).hexdigest()[:16]


@pytest.mark.shows("output/action", "gate/NetworkPolicy", "gate/Mux")
def test_the_goals_of_a_standby_do_not_reach_the_robot_until_it_takes_over(kubectl: Kubectl, gate_kind: str) -> None:
    robot = Gripping(kubectl, gate_kind=gate_kind)
    kubectl.apply(patient(manifest("strategies/executing.yaml")))
    kubectl.apply(robot.with_gripper("quickstart-executing"))
    old = robot.wait_protected()
    robot.wait_standby()
    (standby,) = (pod["metadata"]["name"] for pod in robot.pods() if pod["metadata"]["name"] != old)
    robot.wait_goals(old)
    eventually(
        lambda: f"sent {ENOUGH}" in kubectl("logs", standby, "-c", CONTAINER).splitlines(),
        within=30,
        what="the standby sends goals too",
        note=robot.describe,
    )
    never(robot.goals(standby), "goals of the standby")

    robot.freeze(old)
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.new) == ("Fallback/Executing", standby), recovery
    robot.wait_goals(standby)
    assert_handed_over(robot, recovery)
    goals, switch = robot.goals(), recovery.moments["decided"]
    senders = [name for name, _ in groupby(goals, key=lambda goal: str(goal["sender"]))]
    never([] if senders == [sender(old), sender(standby)] else goals, "goals of two instances in turn")
    never(
        [goal for goal in robot.goals(standby) if goal["received"] < switch], "goals of the standby before the switch"
    )
    oldest = min(goal["sent"] for goal in robot.goals(standby))
    assert oldest > switch - seconds(REQUEST_LIFESPAN) - BUSY, "goals from before the switch expire"
