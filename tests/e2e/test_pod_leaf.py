"""A health tree that looks at what Kubernetes says of the pod in control: restarts of its containers, and its conditions."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import CONTAINER, READINESS_PROBE, Robot, eventually, manifest, patient
from tests.e2e.test_strategies import assert_handed_over

SILENCE = "120s"
"""What the outputs may be silent for: it is the pod that is to be found."""


def looking_at(pod: Object) -> list[Object]:
    """A policy that restarts if this leaf fails, and hardly looks at the outputs."""
    [policy] = patient(manifest("strategies/restart.yaml"), gap=SILENCE)
    policy["spec"]["monitoring"]["yaml"]["parallel"].append({"pod": pod})
    return [policy]


def restarts(robot: Robot, pod: str) -> int:
    statuses = robot.kubectl.get("pod", pod)["status"].get("containerStatuses") or []
    return sum(status["restartCount"] for status in statuses if status["name"] == CONTAINER)


@pytest.mark.long
@pytest.mark.shows("leaf/pod")
def test_one_restart_is_allowed_and_the_next_is_one_too_many(kubectl: Kubectl, gate_kind: str) -> None:
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(looking_at({"restarts": 1, "window": "10m"}))
    kubectl.apply(robot.objects(policy="quickstart-restart"))
    old = robot.wait_protected()

    robot.fail(old, "killed")
    eventually(lambda: restarts(robot, old) == 1, within=60, what="its container is started again", note=robot.describe)
    assert robot.wait_driven() == old
    assert robot.recoveries() == [], "once is no failure"

    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=180)
    assert recovery.old == old, recovery
    assert recovery.reason == "containers of the pod were restarted 2 times within 600 s", recovery
    assert recovery.strategy == "Restart", recovery
    assert_handed_over(robot, recovery)


@pytest.mark.long
@pytest.mark.shows("leaf/pod")
def test_a_pod_that_is_no_longer_ready_fails_though_its_outputs_flow(kubectl: Kubectl, gate_kind: str) -> None:
    def with_probe(item: Object) -> None:
        [container] = item["spec"]["template"]["spec"]["containers"]
        container["readinessProbe"] = READINESS_PROBE

    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(looking_at({"condition": "ContainersReady", "for": "3s"}))
    kubectl.apply(robot.objects(policy="quickstart-restart", edit=with_probe))
    old = robot.wait_protected()

    robot.fail(old, "unready")
    recovery = robot.wait_recovered(1, within=120)
    assert recovery.old == old, recovery
    assert recovery.reason.startswith("condition ContainersReady of the pod is False"), recovery
    assert recovery.reason.endswith(", but True is required (violated for 3 s)"), recovery
    assert robot.wait_driven() == recovery.new
    commands = robot.log().of(old)
    assert commands, "it drove"
    assert commands[-1].received > recovery.moments["detected"] - 2.0, "and went on driving until that was found"
