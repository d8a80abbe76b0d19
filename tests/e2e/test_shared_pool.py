"""Two workloads and the last pod of their pool: one owner, and the other robot is not left alone."""

from __future__ import annotations

import threading

from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, eventually, manifest
from tests.e2e.test_strategies import assert_handed_over


def test_two_workloads_claiming_the_last_pod_have_one_owner(kubectl: Kubectl) -> None:
    kubectl.apply(manifest("strategies/uninitialized.yaml"))
    robots = [Robot(kubectl, name) for name in ("robot-1", "robot-2")]
    for robot in robots:
        kubectl.apply(robot.objects(policy="quickstart-uninitialized"))
    old = {robot.name: robot.wait_protected() for robot in robots}
    [spare] = [
        p for p in kubectl.list("pods", "understudy.dev/held=true") if not p["metadata"].get("deletionTimestamp")
    ]
    # The refill must not come between the two claims: what is tested is the last pod.
    threads = [threading.Thread(target=robot.fail, args=(old[robot.name], "killed")) for robot in robots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
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
        assert not others & set(robot.log().sources()), "no robot ever heard another robot's instance"
    eventually(
        lambda: any(
            p["metadata"]["name"] != spare["metadata"]["name"] for p in kubectl.list("pods", "understudy.dev/held=true")
        ),
        within=60,
        what="the pool is refilled",
    )
