"""An existing Deployment is protected without a change to it, and is as before when the protection is gone."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest
from tests.e2e.test_strategies import assert_handed_over


def unchanged(before: dict[str, object], after: dict[str, object]) -> bool:
    return before["spec"] == after["spec"] and {
        key: value for key, value in before["metadata"].items() if key in ("labels", "annotations", "generation", "uid")
    } == {
        key: value for key, value in after["metadata"].items() if key in ("labels", "annotations", "generation", "uid")
    }


def _observed(kubectl: Kubectl) -> Object | None:
    """The Deployment once its controller has annotated it with its revision."""
    found = kubectl.get("deployment", "drive")
    return found if "deployment.kubernetes.io/revision" in (found["metadata"].get("annotations") or {}) else None


@pytest.mark.parametrize("strategy", ["executing", pytest.param("restart", marks=pytest.mark.long)])
def test_a_deployment_is_protected_without_a_change_to_it(kubectl: Kubectl, strategy: str) -> None:
    robot = Robot(kubectl)
    kubectl.apply(manifest("workload-ref/deployment.yaml"))
    before = eventually(lambda: _observed(kubectl), within=30, what="the Deployment's own controller has seen it")
    kubectl.apply(manifest("robot.yaml"))
    kubectl.apply(manifest(f"strategies/{strategy}.yaml"))
    [workload] = manifest("workload-ref/robotworkload.yaml")
    workload["spec"]["failurePolicyRef"]["name"] = f"quickstart-{strategy}"
    kubectl.apply([workload])
    old = robot.wait_protected()
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == {"executing": "Fallback/Executing", "restart": "Restart"}[strategy]
    assert_handed_over(robot, recovery)
    assert unchanged(before, kubectl.get("deployment", "drive")), "the Deployment is untouched but for its pods' labels"
    if strategy == "executing":
        second_old = robot.wait_protected()
        robot.fail(second_old, "killed")
        second = robot.wait_recovered(2)
        words = f"a standby with an agent takes over, never the Deployment's own pod: {second.attempts}"
        assert not second.new.startswith("drive-"), words
        assert_handed_over(robot, second)
    kubectl("delete", "robotworkload", robot.workload)
    eventually(
        lambda: (
            not [
                label
                for pod in kubectl.list("pods", "app=drive")
                for label in pod["metadata"]["labels"]
                if label.startswith("understudy.dev/")
            ]
        ),
        within=60,
        what="the Deployment's pods carry no label of ours",
    )
    assert unchanged(before, kubectl.get("deployment", "drive"))
