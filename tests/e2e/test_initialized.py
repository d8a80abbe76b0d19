"""A managed application: brought up by Understudy, and followed by a standby that waits configured."""

from __future__ import annotations

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest
from tests.e2e.test_strategies import assert_handed_over

POOL = "quickstart-initialized"


def standbys(robot: Robot) -> list[Object]:
    active = robot.status().get("active")
    return [
        pod
        for pod in robot.pods()
        if pod["metadata"]["name"] != active and not pod["metadata"].get("deletionTimestamp")
    ]


def is_ready(pod: Object) -> bool:
    conditions = pod["status"].get("conditions") or []
    return any((c["type"], c["status"]) == ("Ready", "True") for c in conditions)


def wait_counted(robot: Robot, ready: int) -> None:
    """Wait until the pool counts so many of its standbys as ready."""
    eventually(
        lambda: (robot.kubectl.get("fallbackpool", POOL).get("status") or {}).get("ready") == ready,
        within=90,
        what=f"{ready} standbys of {POOL} are ready",
        note=robot.describe,
    )


def wait_standing_by(robot: Robot) -> None:
    """Wait until the workload says that its standby is ready; operator and monitor each tell their own part of it."""
    eventually(
        lambda: robot.status().get("standby") == "Initialized (1/1)",
        within=90,
        what=f"{robot.name} has its standby",
        note=robot.describe,
    )


@pytest.mark.parametrize(
    "how", [pytest.param("killed", marks=pytest.mark.long), "frozen", pytest.param("deleted", marks=pytest.mark.long)]
)
@pytest.mark.shows("strategy/Fallback", "readiness/Initialized", "step/set_lifecycle", "step/wait_for")
def test_a_configured_standby_is_activated_and_takes_over(managed: Robot, how: str) -> None:
    old = managed.wait_protected()
    wait_counted(managed, 1)
    wait_standing_by(managed)
    managed.fail(old, how)
    recovery = managed.wait_recovered(1)
    assert recovery.strategy == "Fallback/Initialized", recovery
    assert recovery.parts["startup"] == 0, "its processes were up"
    assert recovery.parts["reinitialization"] > 0
    assert_handed_over(managed, recovery)
    assert managed.wait_protected() == recovery.new, "and it is protected again"
    wait_standing_by(managed)  # the pod that its own controller made instead
    eventually(
        lambda: managed.condition("BroughtUp").get("status") == "True",
        within=90,
        what="every instance is where it should be brought",
        note=managed.describe,
    )


@pytest.mark.long
@pytest.mark.own_robot  # its pool is deleted
@pytest.mark.shows("condition/lifecycle_is")
def test_a_standby_counts_only_while_its_check_holds_and_is_replaced_otherwise(managed: Robot) -> None:
    active = managed.wait_protected()
    wait_counted(managed, 1)
    (standby,) = (pod["metadata"]["name"] for pod in standbys(managed) if is_ready(pod))
    managed.signal(standby, "STOP")
    eventually(
        lambda: not managed.has_pod(standby) or not any(is_ready(pod) for pod in standbys(managed)),
        within=60,
        what=f"{standby} is not ready any more",
        note=managed.describe,
    )
    eventually(
        lambda: not any(pod["metadata"]["name"] == standby for pod in standbys(managed)),
        within=90,
        what=f"{standby} is replaced",
        note=managed.describe,
    )
    events = managed.kubectl.list("events")
    assert any(e["reason"] == "StandbyReplaced" and standby in e["message"] for e in events)
    wait_counted(managed, 1)
    assert managed.status()["active"] == active, "the robot went on"

    managed.kubectl("delete", "fallbackpool", POOL, "--wait=true")
    eventually(
        lambda: managed.status().get("strategy") == "Restart" and not standbys(managed),
        within=60,
        what="standbys go with their pool",
        note=managed.describe,
    )


@pytest.mark.shows("strategy/Restart", "step/set_lifecycle")
def test_a_restarted_managed_application_is_brought_up_again(kubectl: Kubectl, gate_kind: str) -> None:
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(manifest("strategies/restart.yaml"))
    kubectl.apply(robot.objects(policy="quickstart-restart", workload="managed/robotworkload.yaml"))
    robot.fail(robot.wait_protected(), "deleted")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Restart", recovery
    assert recovery.parts["startup"] > 0
    assert_handed_over(robot, recovery)
