"""What a policy's limits and a pause keep from being done, seen from the robot: nobody drives, and nothing is used up."""

from __future__ import annotations

import time

import pytest

from tests.e2e.console import understudy
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, eventually, manifest, never, patient
from tests.e2e.test_shared_pool import fail_at_once
from tests.e2e.test_strategies import assert_handed_over

SAFE = "safe"
WATCHED = 8.0
"""Seconds for which it is looked whether nothing is done."""


def executing_with(kubectl: Kubectl, gate_kind: str, **spec: object) -> Robot:
    robot = Robot(kubectl, gate_kind=gate_kind)
    policy, pool = patient(manifest("strategies/executing.yaml"))
    policy["spec"] |= spec
    kubectl.apply([policy, pool])
    kubectl.apply(robot.objects(policy="quickstart-executing"))
    return robot


def assert_nothing_is_done(robot: Robot) -> None:
    """Whatever there was stays, and nobody of it drives."""
    pods = {pod["metadata"]["uid"] for pod in robot.pods()}
    begun, recoveries = time.time(), robot.status().get("recoveryCount", 0)
    time.sleep(WATCHED)
    assert robot.status().get("recoveryCount", 0) == recoveries
    assert {pod["metadata"]["uid"] for pod in robot.pods()} == pods, "nothing was claimed, started or deleted"
    driven = {c.source for c in robot.log().commands if c.received > begun} - {SAFE}
    never(driven, "they drove")


@pytest.mark.long
def test_a_spent_budget_leads_to_safe_commands_until_somebody_resumes(kubectl: Kubectl, gate_kind: str) -> None:
    command = {"topic": "/cmd_vel", "every": "50ms", "message": {"header": {"frame_id": SAFE, "stamp": "now"}}}
    robot = executing_with(
        kubectl,
        gate_kind,
        limits={"budget": {"recoveries": 1, "within": "1h"}},
        safety={"after": "200ms", "commands": [command]},
    )
    first = robot.wait_protected()
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    eventually(
        lambda: robot.condition("Protected").get("reason") == "BudgetSpent",
        within=30,
        what="it is told that the next failure won't be recovered",
        note=robot.describe,
    )
    assert robot.condition("WithinBudget")["status"] == "False"
    robot.wait_standby()

    robot.fail(recovery.new, "frozen")
    held = eventually(
        lambda: (found := robot.condition("Recovering")).get("reason") == "BudgetSpent" and found,
        within=30,
        what="the failure is held",
        note=robot.describe,
    )
    assert f"understudy resume -n {kubectl.namespace} {robot.workload}" in held["message"]
    time.sleep(1)
    assert_nothing_is_done(robot)
    assert robot.log().of(SAFE), "the robot is told to stand still"
    explained = understudy(kubectl, "explain", robot.workload)
    assert explained.returncode == 1
    assert "(BudgetSpent" in explained.stdout

    robot.replace_monitor()
    assert_nothing_is_done(robot)

    assert understudy(kubectl, "resume", robot.workload).returncode == 0
    again = robot.wait_recovered(2)
    assert again.strategy == "Fallback/Executing", again
    assert again.moments["held"] < again.moments["released"] <= again.moments["routed"]
    assert robot.wait_driven() == again.new


@pytest.mark.long
def test_the_budget_is_available_again_after_its_window(kubectl: Kubectl, gate_kind: str) -> None:
    robot = executing_with(kubectl, gate_kind, limits={"budget": {"recoveries": 1, "within": "30s"}})
    first = robot.wait_protected()
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    robot.wait_standby()
    robot.fail(recovery.new, "frozen")
    again = robot.wait_recovered(2, within=120)
    assert again.moments["released"] >= recovery.moments["detected"] + 30
    assert_handed_over(robot, again)


def test_a_failure_during_a_pause_is_recovered_after_it(executing: Robot) -> None:
    kubectl, name = executing.kubectl, executing.workload
    active = executing.wait_protected()
    assert understudy(kubectl, "pause", name, "--reason", "a new gripper", "--owner", "ann").returncode == 0
    eventually(
        lambda: executing.condition("Protected").get("reason") == "Paused",
        within=10,
        what="it is paused",
        note=executing.describe,
    )
    assert "ann: a new gripper" in executing.condition("Paused")["message"]

    executing.fail(active, "frozen")
    eventually(
        lambda: executing.condition("Recovering").get("reason") == "Paused",
        within=10,
        what="the failure is told",
        note=executing.describe,
    )
    assert executing.status()["health"] == "Failed"
    assert_nothing_is_done(executing)
    assert executing.status()["active"] == active

    assert understudy(kubectl, "resume", name).returncode == 0
    recovery = executing.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing"
    assert executing.wait_driven() == recovery.new
    assert not executing.condition("Paused")


def test_a_pause_ends_at_its_time(executing: Robot) -> None:
    executing.wait_protected()
    begun = time.time()
    paused = understudy(executing.kubectl, "pause", executing.workload, "--reason", "a photo", "--for", "8s")
    assert paused.returncode == 0
    over = eventually(
        lambda: (found := executing.condition("Paused")).get("status") == "False" and found,
        within=60,
        what="it is over",
        note=executing.describe,
    )
    assert over["reason"] == "Over"
    assert time.time() >= begun + 7
    executing.wait_protected()
    assert understudy(executing.kubectl, "resume", executing.workload).returncode == 0


@pytest.mark.long
def test_a_failure_soon_after_a_recovery_starts_the_next_strategy_even_after_a_monitor_restart(
    kubectl: Kubectl, gate_kind: str
) -> None:
    robot = executing_with(kubectl, gate_kind, limits={"healthyDelay": "5m"})
    first = robot.wait_protected()
    robot.fail(first, "frozen")
    recovery = robot.wait_recovered(1)
    robot.wait_driven()
    robot.wait_standby()
    robot.replace_monitor()
    robot.wait_driven()
    robot.fail(recovery.new, "frozen")
    relapse = robot.wait_recovered(2)
    assert relapse.strategy == "Restart", relapse
    told = [event for event in kubectl.list("events") if event["reason"] == "Relapsed"]
    assert any("limits.healthyDelay is 5m" in event["message"] for event in told), told


@pytest.mark.long
def test_a_robot_that_fails_in_a_storm_waits_until_the_storm_is_over(kubectl: Kubectl, gate_kind: str) -> None:
    policy, pool = patient(manifest("strategies/uninitialized.yaml"))
    policy["spec"]["limits"] = {"stormGuard": {"percent": 50, "workloads": 2, "within": "40s"}}
    kubectl.apply([policy, pool])
    robots = [Robot(kubectl, f"robot-{number}", gate_kind=gate_kind) for number in (1, 2, 3)]
    for robot in robots:
        kubectl.apply(robot.objects(policy="quickstart-uninitialized"))
    pods = {robot.name: robot.wait_driven(180) for robot in robots}

    def storm() -> str:
        conditions = kubectl.get("failurepolicy", "quickstart-uninitialized")["status"]["conditions"]
        return next((c["status"] for c in conditions if c["type"] == "Storm"), "")

    assert storm() == "False"
    *first, last = robots
    fail_at_once(first, pods)
    eventually(lambda: storm() == "True", within=20, what="it is said that a storm is on", note=last.describe)
    last.fail(pods[last.name], "frozen")
    eventually(
        lambda: last.condition("Recovering").get("reason") == "Storm",
        within=20,
        what="the third robot waits",
        note=last.describe,
    )
    assert last.status()["active"] == pods[last.name], "it isn't fenced"
    assert last.status().get("recoveryCount", 0) == 0
    # Its own failure keeps two of three from being well until the others' are long enough ago.
    eventually(lambda: storm() == "False", within=120, what="it is over", note=last.describe)
    recovery = last.wait_recovered(1)
    assert recovery.old == pods[last.name]
    last.wait_driven()
