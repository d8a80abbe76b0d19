"""A policy with requirements: the operator chooses its strategies and keeps standbys for them, and again if the requirements change."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, patient
from tests.e2e.test_strategies import assert_handed_over

POLICY = "quickstart-executing"


def requiring(**levels: str) -> list[Object]:
    """A policy with these requirements, and a pool that can be chosen."""
    policy, pool = patient(manifest("strategies/executing.yaml"))
    policy["spec"] |= {"requirements": levels, "strategies": [{"type": "Auto", "verifyWithin": "60s"}]}
    return [policy, pool]


def wait_chosen(robot: Robot, strategy: str, instances: int) -> None:
    """Wait until a strategy would recover the robot, and it has as many instances as that needs."""

    def chosen() -> bool:
        kept = [pod for pod in robot.pods() if not pod["metadata"].get("deletionTimestamp")]
        met = robot.condition("StrategiesChosen").get("status") == "True"
        return met and robot.status().get("strategy") == strategy and len(kept) == instances

    eventually(chosen, within=90, what=f"{strategy} is chosen", note=robot.describe)


@pytest.mark.shows("strategy/Auto", "strategy/Fallback", "strategy/Restart", "readiness/Executing")
def test_other_requirements_change_what_is_kept_ready_and_what_recovers(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    kubectl.apply(requiring(availability="High"))
    kubectl.apply(robot.objects(policy=POLICY))
    old = robot.wait_protected()
    wait_chosen(robot, "Executing", instances=2)
    robot.fail(old, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert_handed_over(robot, recovery)

    kubectl.apply(requiring(availability="Low", resourceUsage="Low"))
    wait_chosen(robot, "Restart", instances=1)
    assert robot.wait_protected() == recovery.new, "the robot went on"
    robot.fail(recovery.new, "deleted")
    recovery = robot.wait_recovered(2)
    assert recovery.strategy == "Restart", recovery
    assert_handed_over(robot, recovery)
