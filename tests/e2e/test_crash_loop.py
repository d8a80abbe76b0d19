"""An application that ends again and again right after its start, seen from the robot: another strategy has its turn, and
when none is left, that is reported, and nothing thrashes.
"""

from __future__ import annotations

import time

import pytest

from tests.e2e.faults import Switch
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest, never, patient
from tests.e2e.test_strategies import assert_handed_over

PATIENCE = 240.0
"""Seconds that the first strategy would have, if it were not given up before."""

LAST = 10.0
"""Seconds that the last strategy has."""

OBSERVED = 25.0
"""Seconds for which it is counted what is done while nothing helps."""


def is_crash_looping(pod: Object) -> bool:
    statuses = pod["status"].get("containerStatuses") or []
    reasons = [((status.get("state") or {}).get("waiting") or {}).get("reason") for status in statuses]
    return "CrashLoopBackOff" in reasons


def living(robot: Robot) -> set[str]:
    return {pod["metadata"]["name"] for pod in robot.pods() if not pod["metadata"].get("deletionTimestamp")}


@pytest.mark.long
def test_a_crash_loop_starts_the_next_strategy_before_the_first_one_times_out(kubectl: Kubectl, gate_kind: str) -> None:
    switch, robot = Switch(kubectl), Robot(kubectl, gate_kind=gate_kind)
    policy, pool = patient(manifest("strategies/uninitialized.yaml"))
    fallback, restart = policy["spec"]["strategies"]
    policy["spec"]["strategies"] = [restart | {"verifyWithin": f"{PATIENCE:g}s"}, fallback]
    [workload] = manifest("robotworkload.yaml")
    del pool["spec"]["templateFrom"]
    pool["spec"]["template"] = workload["spec"]["template"]  # as it was before it was spoilt
    kubectl.apply([policy, pool])
    kubectl.apply(
        robot.objects(policy="quickstart-uninitialized", edit=lambda item: switch.put_into(item["spec"]["template"]))
    )
    old = robot.wait_driven()
    eventually(
        lambda: (kubectl.get("fallbackpool", "quickstart-uninitialized").get("status") or {}).get("ready") == 1,
        within=90,
        what="the pool has its pod",
        note=robot.describe,
    )

    switch.on()
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=PATIENCE - 60)

    assert recovery.strategy == "Fallback/Uninitialized", recovery
    first, second = recovery.attempts
    assert (first["strategy"], first["result"]) == ("Restart", "NotVerified"), recovery
    assert "crash-looping" in first["message"], recovery
    assert second["result"] == "Verified", recovery
    assert_handed_over(robot, recovery)
    assert robot.wait_driven() == recovery.new
    assert robot.log().sources() == [old, recovery.new], "what crashed never drove"
    assert robot.condition("Healthy")["status"] == "True"


@pytest.mark.long
def test_a_crash_loop_of_every_strategy_is_reported_without_thrashing_until_an_instance_works(
    kubectl: Kubectl, gate_kind: str
) -> None:
    switch, robot = Switch(kubectl), Robot(kubectl, gate_kind=gate_kind)
    policy, pool = patient(manifest("strategies/executing.yaml"))
    policy["spec"]["strategies"][-1]["verifyWithin"] = f"{LAST:g}s"
    policy["spec"]["monitoring"]["startupGrace"] = "15s"
    kubectl.apply([policy, pool])
    kubectl.apply(
        robot.objects(policy="quickstart-executing", edit=lambda item: switch.put_into(item["spec"]["template"]))
    )
    first = robot.wait_protected()

    switch.on()
    robot.fail(first, "killed")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing", recovery
    assert_handed_over(robot, recovery)
    second = recovery.new
    eventually(
        lambda: any(is_crash_looping(pod) for pod in robot.pods()),
        within=90,
        what="the next understudy ends again and again",
        note=robot.describe,
    )
    assert robot.status()["active"] == second
    assert robot.condition("Protected")["status"] != "True", "nobody counts on it"
    assert len(robot.recoveries()) == 1

    robot.fail(second, "killed")
    failed = eventually(
        lambda: next((r for r in robot.recoveries() if r.result == "Failed"), None),
        within=120,
        what="it is told that nothing verified",
        note=robot.describe,
    )
    assert [attempt["strategy"] for attempt in failed.attempts] == ["Fallback/Executing", "Restart"]
    told = [e for e in kubectl.list("events") if e["reason"] == "RecoveryFailed" and e["type"] == "Warning"]
    assert any("Restart: NotVerified" in event["message"] for event in told), told
    condition = eventually(
        lambda: (found := robot.condition("Recovering")).get("reason") == "NothingVerified" and found,
        within=90,
        what="a condition says that nothing verified",
        note=robot.describe,
    )
    assert condition["status"] == "False"
    assert "Restart: NotVerified" in condition["message"]
    assert robot.condition("Healthy")["status"] != "True"

    begun, seen, recoveries = time.monotonic(), living(robot), robot.status()["recoveryCount"]
    while time.monotonic() - begun < OBSERVED:
        now = living(robot)
        assert len(now) <= 4, f"{now}: pods pile up"
        seen |= now
        time.sleep(1)
    took = time.monotonic() - begun
    rounds = took / LAST + 1
    assert robot.status()["recoveryCount"] - recoveries <= rounds
    assert len(seen) <= 2 + 2 * rounds, f"{seen}: a new pod again and again"
    never(set(robot.log().sources()) - {first, second}, "what crashed reached the robot")

    switch.off()
    third = robot.wait_driven(180)
    assert third not in (first, second)
    eventually(
        lambda: (
            robot.condition("Healthy").get("status") == "True"
            and robot.condition("Recovering").get("reason") in ("Recovered", "HealthyAgain")
        ),
        within=60,
        what="it is told that it is well again",
        note=robot.describe,
    )
    never(robot.log().returns(), "control moved back")
    assert robot.status()["active"] == third


@pytest.mark.long
def test_the_next_strategy_is_tried_if_the_new_instance_crashes_once_it_drives(
    kubectl: Kubectl, gate_kind: str
) -> None:
    """A restarted instance is seen to drive, and ends; the next failure isn't answered by the same strategy."""
    robot = Robot(kubectl, gate_kind=gate_kind)
    policy, pool = manifest("strategies/uninitialized.yaml")
    policy["spec"]["strategies"].reverse()
    kubectl.apply([policy, pool])
    kubectl.apply(robot.objects(policy="quickstart-uninitialized"))
    old = robot.wait_driven()
    eventually(
        lambda: (kubectl.get("fallbackpool", "quickstart-uninitialized").get("status") or {}).get("ready") == 1,
        within=90,
        what="the pool has its pod",
        note=robot.describe,
    )
    robot.fail(old, "killed")
    first = robot.wait_recovered(1)
    robot.fail(first.new, "killed")
    second = robot.wait_recovered(2)
    assert first.strategy == "Restart"
    if (lived := second.moments["lastHealthy"] - first.moments["verified"]) > 3.5:
        pytest.skip(f"it was killed only after {lived:.1f} s: this machine is too busy to have it end at once")
    assert second.strategy == "Fallback/Uninitialized", second
    assert_handed_over(robot, second)
