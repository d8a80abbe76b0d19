"""Waiting pods of a shared pool are replaced while a robot counts on them: by a new template, from a node that is to be emptied."""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest
from tests.e2e.test_strategies import assert_handed_over

POOL = "quickstart-uninitialized"


def pool_of(robot: Robot, **spec: object) -> list[Object]:
    """The policy, and its pool with a template of its own."""
    (workload,) = [item for item in robot.objects(policy=POOL) if item["kind"] == "RobotWorkload"]
    found = manifest("strategies/uninitialized.yaml")
    for item in found:
        if item["kind"] == "FallbackPool":
            del item["spec"]["templateFrom"]
            item["spec"] |= {"template": copy.deepcopy(workload["spec"]["template"]), **spec}
    return found


def held(kubectl: Kubectl) -> list[Object]:
    """The pods that nobody has claimed and that stay."""
    found = kubectl.list("pods", "understudy.dev/held=true")
    return [pod for pod in found if not pod["metadata"].get("deletionTimestamp")]


def uids(pods: list[Object]) -> set[str]:
    return {pod["metadata"]["uid"] for pod in pods}


def status(kubectl: Kubectl) -> Object:
    found: Object = kubectl.get("fallbackpool", POOL)["status"]
    return found


def change_template(kubectl: Kubectl) -> None:
    """As an upgrade of its image would."""
    template = kubectl.get("fallbackpool", POOL)["spec"]["template"]
    template["spec"]["containers"][0].setdefault("env", []).append({"name": "EDITION", "value": "2"})
    kubectl.patch("fallbackpool", POOL, {"spec": {"template": template}})


def least_ready(kubectl: Kubectl, done: Callable[[], bool], within: float) -> int:
    """How few could be claimed at any time until it was done."""
    least, end = status(kubectl)["ready"], time.monotonic() + within
    while not done():
        assert time.monotonic() < end, f"not within {within:g} s: {status(kubectl)}"
        least = min(least, status(kubectl)["ready"])
        time.sleep(0.2)
    return int(least)


@pytest.fixture
def robot(kubectl: Kubectl, gate_kind: str) -> Robot:
    return Robot(kubectl, gate_kind=gate_kind)


def protect(robot: Robot, **spec: object) -> str:
    """Protect it by a pool. Returns the active pod."""
    robot.kubectl.apply(pool_of(robot, **spec))
    robot.kubectl.apply(robot.objects(policy=POOL))
    return robot.wait_protected()


def test_a_rollout_of_a_new_template_keeps_the_configured_number_of_pods_ready(robot: Robot) -> None:
    kubectl = robot.kubectl
    old = protect(robot, replicas=2, updateStrategy={"type": "Recreate", "minReady": 1})
    eventually(lambda: status(kubectl)["ready"] == 2, within=90, what="both are ready")
    before = uids(held(kubectl))
    change_template(kubectl)
    least = least_ready(kubectl, lambda: len(held(kubectl)) == 2 and not uids(held(kubectl)) & before, within=120)
    assert least >= 1
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=150)
    assert recovery.strategy == "Fallback/Uninitialized"
    assert_handed_over(robot, recovery)


@pytest.mark.long
def test_on_replenish_a_pod_of_the_old_template_takes_over_and_the_next_is_of_the_new_one(robot: Robot) -> None:
    kubectl = robot.kubectl
    old = protect(robot, updateStrategy={"type": "OnReplenish"})
    (spare,) = held(kubectl)
    change_template(kubectl)
    eventually(lambda: status(kubectl)["updated"] == 0, within=30, what="it is of an earlier template")
    robot.wait_protected()
    assert uids(held(kubectl)) == uids([spare])
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=150)
    assert (recovery.strategy, recovery.new) == ("Fallback/Uninitialized", spare["metadata"]["name"])
    assert_handed_over(robot, recovery)
    eventually(lambda: status(kubectl)["updated"] == 1, within=90, what="the next one is of the new template")


def stay_on(node: str) -> Callable[[Object], None]:
    """Have a workload's own pod on a node."""

    def edit(workload: Object) -> None:
        workload["spec"]["template"]["spec"]["affinity"] = only("In", node)

    return edit


@pytest.fixture
def cordoned(kubectl: Kubectl) -> Iterator[Callable[[str], None]]:
    """Cordons nodes, until the test has ended."""
    found: list[str] = []

    def cordon(node: str) -> None:
        found.append(node)
        kubectl("cordon", node)

    yield cordon
    for node in found:
        kubectl("uncordon", node)


def only(operator: str, node: str) -> Object:
    """An affinity to a node (In), or to all others (NotIn)."""
    here = {"key": "kubernetes.io/hostname", "operator": operator, "values": [node]}
    terms = {"nodeSelectorTerms": [{"matchExpressions": [here]}]}
    return {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": terms}}


@pytest.mark.local_only
def test_from_a_node_that_is_to_be_emptied_the_pool_moves_before_its_pods_go(
    robot: Robot, cordoned: Callable[[str], None]
) -> None:
    kubectl = robot.kubectl
    first = min(node["metadata"]["name"] for node in kubectl.list("nodes"))
    apart = pool_of(robot)
    for item in apart:
        if item["kind"] == "FallbackPool":
            item["spec"]["template"]["spec"]["affinity"] = only("NotIn", first)
    kubectl.apply(apart)
    kubectl.apply(robot.objects(policy=POOL, edit=stay_on(first)))
    old = robot.wait_protected()
    (spare,) = held(kubectl)
    node = spare["spec"]["nodeName"]
    cordoned(node)
    # Drains evict as soon as they have cordoned; what else is on the node stays there.
    asked = ("drain", node, "--pod-selector=understudy.dev/held=true", "--delete-emptydir-data")
    drain = threading.Thread(target=kubectl, args=asked, kwargs={"timeout": 150})
    drain.start()
    least = least_ready(kubectl, lambda: not uids(held(kubectl)) & uids([spare]), within=120)
    assert least == 1, "one could be claimed all the time"
    drain.join(60)
    assert not drain.is_alive(), "the drain has ended"
    (new,) = held(kubectl)
    assert new["spec"]["nodeName"] != node
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1, within=150)
    assert recovery.strategy == "Fallback/Uninitialized"
    assert_handed_over(robot, recovery)
