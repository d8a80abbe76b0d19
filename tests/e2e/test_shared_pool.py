"""Several workloads and one pool: the last pod has one owner, and the other robot is not left alone, nor served out of turn."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import APPLICATION, CONTAINER, Robot, eventually, manifest, never
from tests.e2e.test_strategies import assert_handed_over

POOL = "quickstart-uninitialized"


def fail_at_once(robots: list[Robot], pods: dict[str, str]) -> None:
    """Make the instances of several robots fail at the same time."""
    threads = [threading.Thread(target=robot.fail, args=(pods[robot.name], "killed")) for robot in robots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def waiting(wait_for: str) -> list[Object]:
    """The pool, and the policy that waits for a pod of it before it restarts anything."""
    found = manifest("strategies/uninitialized.yaml")
    for item in found:
        if item["kind"] == "FailurePolicy":
            item["spec"]["strategies"][0]["waitFor"] = wait_for
    return found


def of_priority(priority: int) -> Callable[[Object], None]:
    def edit(workload: Object) -> None:
        workload["spec"]["poolPriority"] = priority

    return edit


def run_dry(kubectl: Kubectl) -> None:
    """Take away every pod of the pool that nobody has claimed."""
    kubectl.patch("fallbackpool", POOL, {"spec": {"replicas": 0}})
    eventually(lambda: not kubectl.list("pods", "understudy.dev/held=true"), within=60, what="the pool is empty")


def available(kubectl: Kubectl) -> Object:
    conditions: list[Object] = kubectl.get("fallbackpool", POOL)["status"]["conditions"]
    return next(c for c in conditions if c["type"] == "Available")


@pytest.mark.long
def test_two_workloads_claiming_the_last_pod_have_one_owner(kubectl: Kubectl, gate_kind: str) -> None:
    kubectl.apply(manifest("strategies/uninitialized.yaml"))
    robots = [Robot(kubectl, name, gate_kind=gate_kind) for name in ("robot-1", "robot-2")]
    for robot in robots:
        kubectl.apply(robot.objects(policy="quickstart-uninitialized"))
    old = {robot.name: robot.wait_protected() for robot in robots}
    [spare] = [
        p for p in kubectl.list("pods", "understudy.dev/held=true") if not p["metadata"].get("deletionTimestamp")
    ]
    # The refill must not come between the two claims: what is tested is the last pod.
    fail_at_once(robots, old)
    recoveries = {robot.name: robot.wait_recovered(1, within=150) for robot in robots}
    claimed = {p["metadata"]["name"]: p for p in kubectl.list("pods", "understudy.dev/pool=quickstart-uninitialized")}
    owners = [owner["name"] for owner in claimed[spare["metadata"]["name"]]["metadata"]["ownerReferences"]]
    assert len(owners) == 1
    winners = [name for name, recovery in recoveries.items() if recovery.new == spare["metadata"]["name"]]
    assert [f"{winner}-drive" for winner in winners] == owners, "the pod drives the robot that owns it, and no other"
    for robot in robots:
        assert_handed_over(robot, recoveries[robot.name])
        others = {pod for name, pod in old.items() if name != robot.name} | {
            recovery.new for name, recovery in recoveries.items() if name != robot.name
        }
        never(others & set(robot.log().sources()), "a robot heard another robot's instance")
    eventually(
        lambda: any(
            p["metadata"]["name"] != spare["metadata"]["name"] for p in kubectl.list("pods", "understudy.dev/held=true")
        ),
        within=60,
        what="the pool is refilled",
    )


@pytest.mark.long
def test_a_workload_that_finds_the_pool_empty_waits_for_the_next_pod(kubectl: Kubectl, gate_kind: str) -> None:
    kubectl.apply(waiting("120s"))
    robots = [Robot(kubectl, name, gate_kind=gate_kind) for name in ("robot-1", "robot-2")]
    for robot in robots:
        kubectl.apply(robot.objects(policy=POOL))
    old = {robot.name: robot.wait_protected() for robot in robots}
    fail_at_once(robots, old)
    recoveries = {robot.name: robot.wait_recovered(1, within=200) for robot in robots}
    assert {r.strategy for r in recoveries.values()} == {"Fallback/Uninitialized"}, "nobody was restarted"
    assert len({r.new for r in recoveries.values()}) == 2
    for robot in robots:
        assert_handed_over(robot, recoveries[robot.name])
        robot.wait_driven()


@pytest.mark.long
def test_of_two_that_wait_for_a_pod_the_more_critical_is_served_first(kubectl: Kubectl, gate_kind: str) -> None:
    kubectl.apply(waiting("300s"))
    ordinary, critical = robots = [Robot(kubectl, name, gate_kind=gate_kind) for name in ("robot-1", "robot-2")]
    for robot, priority in zip(robots, (0, 100), strict=True):
        kubectl.apply(robot.objects(policy=POOL, edit=of_priority(priority)))
    old = {robot.name: robot.wait_driven() for robot in robots}
    run_dry(kubectl)
    for robot in robots:  # the ordinary one first: it isn't for its place in time that the other is served before it
        robot.fail(old[robot.name], "killed")
        eventually(
            lambda robot=robot: robot.condition("Recovering").get("reason") == "WaitingForPod",  # type: ignore[misc]
            within=60,
            what=f"{robot.name} waits",
            note=robot.describe,
        )
    eventually(
        lambda: "position 2 of 2" in ordinary.condition("Recovering")["message"],
        within=30,
        what="the ordinary one knows its place",
        note=ordinary.describe,
    )
    eventually(lambda: kubectl.get("fallbackpool", POOL)["status"]["waiting"] == 2, within=30, what="the pool tells it")
    dry = available(kubectl)
    assert (dry["status"], dry["reason"]) == ("False", "Dry")
    assert dry["message"].index(critical.workload) < dry["message"].index(ordinary.workload)
    assert all(not p["metadata"]["labels"].get("understudy.dev/pool") for robot in robots for p in robot.pods())
    kubectl.patch("fallbackpool", POOL, {"spec": {"replicas": 1}})
    recoveries = {robot.name: robot.wait_recovered(1, within=250) for robot in robots}
    assert {r.strategy for r in recoveries.values()} == {"Fallback/Uninitialized"}
    first, second = recoveries[critical.name], recoveries[ordinary.name]
    assert first.moments["claimed"] < second.moments["claimed"]
    assert second.moments["queued"] < first.moments["queued"], "though it had waited for less long"
    for robot in robots:
        assert_handed_over(robot, recoveries[robot.name])
        robot.wait_driven()
    eventually(lambda: available(kubectl)["status"] == "True", within=60, what="the pool is filled and nobody waits")


@pytest.mark.long
def test_a_workload_that_waited_for_waitfor_is_restarted(kubectl: Kubectl, gate_kind: str) -> None:
    kubectl.apply(waiting("3s"))
    robot = Robot(kubectl, gate_kind=gate_kind)
    kubectl.apply(robot.objects(policy=POOL))
    old = robot.wait_driven()
    run_dry(kubectl)
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=150)
    assert recovery.strategy == "Restart"
    assert "no pod became free within 3 s" in recovery.attempts[0]["message"]
    assert_handed_over(robot, recovery)


def test_a_claimed_pod_drives_in_the_interpreter_that_waited_with_its_modules(kubectl: Kubectl) -> None:
    found = manifest("strategies/uninitialized.yaml")
    for item in found:
        if item["kind"] == "FallbackPool":
            item["spec"]["preload"] = ["rclpy.node", "geometry_msgs.msg"]
    kubectl.apply(found)
    robot = Robot(kubectl)
    kubectl.apply(robot.objects(policy=POOL))
    old = robot.wait_protected()
    [held] = kubectl.list("pods", "understudy.dev/held=true")
    waiting = held["metadata"]["name"]
    assert "preloaded geometry_msgs.msg in" in kubectl("logs", waiting, "-c", CONTAINER), "before it is claimed"
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.new) == ("Fallback/Uninitialized", waiting)
    assert_handed_over(robot, recovery)
    script = f"for p in /proc/[0-9]*; do grep -qzx {APPLICATION} $p/cmdline && tr '\\0' ' ' <$p/environ; done; true"
    environment = kubectl.shell(waiting, CONTAINER, script)
    assert "PATH=" in environment
    # The kernel shows the variables that the process was executed with.
    assert "ROS_DISCOVERY_SERVER" not in environment, "it was not executed again for its robot"
