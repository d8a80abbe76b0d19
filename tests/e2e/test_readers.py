"""A robot that was started without its DDS profile is reported, and so is its correction."""

from __future__ import annotations

import json

import pytest

from tests.e2e.console import understudy
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest


def without_profile(objects: list[Object]) -> list[Object]:
    """The robot as it is where its profile was forgotten: the volume isn't mounted, and Fast DDS finds no file."""
    (robot,) = (item for item in objects if item["kind"] == "Deployment")
    (container,) = robot["spec"]["template"]["spec"]["containers"]
    container["volumeMounts"] = [mount for mount in container["volumeMounts"] if mount["name"] != "profiles"]
    return objects


@pytest.mark.long
def test_a_robot_without_its_profile_is_reported_until_it_has_it(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    kubectl.apply(manifest("strategies/restart.yaml"))
    objects = robot.objects(policy="quickstart-restart")
    kubectl.apply(without_profile(robot.objects(policy="quickstart-restart")))
    robot.wait_driven()

    eventually(
        lambda: robot.condition("GateEnforced").get("reason") == "ReaderWithoutProfile",
        within=60, what="it is told that the robot has no profile", note=robot.describe,
    )  # fmt: skip
    said = robot.condition("GateEnforced")
    address = kubectl.get("pod", robot.robot_pod())["status"]["podIP"]
    assert said["status"] == "False"
    assert f"/cmd_vel by /robot at {address}:" in said["message"]
    explained = understudy(kubectl, "explain", robot.workload)
    assert "gate not enforced (ReaderWithoutProfile" in " ".join(explained.stdout.split())
    examined = understudy(kubectl, "doctor", robot.workload, "--no-pods", "-o", "json")
    levels = {one["check"]: one["level"] for one in json.loads(examined.stdout)["findings"]}
    assert (examined.returncode, levels[f"gate of {robot.workload}"]) == (1, "FAIL")

    kubectl.apply(objects)
    eventually(
        lambda: robot.condition("OutputsRead").get("reason") == "AtGatedPorts",
        within=120, what="the robot that has its profile is seen at its gated port", note=robot.describe,
    )  # fmt: skip
    eventually(
        lambda: robot.condition("GateEnforced").get("reason") != "ReaderWithoutProfile",
        within=30, what="the gate is as packets say", note=robot.describe,
    )  # fmt: skip
    address = kubectl.get("pod", robot.robot_pod())["status"]["podIP"]
    assert f"/cmd_vel by /robot at {address}:7950" in robot.condition("OutputsRead")["message"]
