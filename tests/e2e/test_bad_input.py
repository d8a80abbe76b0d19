"""Bad input: a condition and an Event that say what to do; nothing crashes, and what is protected stays protected.

A state topic that never comes and a restore target without a subscriber are in test_state.py too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import pytest

from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest
from understudy.api import names

WITHIN = 90.0
"""Seconds for what takes ten on a machine that is not busy."""


def told(kubectl: Kubectl, kind: str, name: str, *words: str) -> None:
    """A condition and a Warning Event of the object have all these words."""

    def has(text: str) -> bool:
        return all(word in text for word in words)

    def condition() -> bool:
        conditions = (kubectl.get(kind, name).get("status") or {}).get("conditions") or []
        return any(c["status"] != "True" and has(f"{c['reason']} {c['message']}") for c in conditions)

    def event() -> bool:
        return any(
            e["involvedObject"]["name"] == name and e["type"] == "Warning" and has(f"{e['reason']} {e['message']}")
            for e in kubectl.list("events")
        )

    def note() -> str:
        return kubectl("describe", kind, name)

    eventually(condition, within=WITHIN, what=f"a condition of {kind} {name} says {words}", note=note)
    eventually(event, within=30, what=f"a Warning Event of {kind} {name} says {words}", note=note)


def test_an_unknown_field_is_refused_by_name(kubectl: Kubectl) -> None:
    [workload] = manifest("robotworkload.yaml")
    workload["spec"]["outptus"] = []
    with pytest.raises(Failed, match="outptus"):
        kubectl.apply([workload])


@pytest.mark.parametrize("both", [True, False])
def test_both_or_none_of_template_and_reference_is_refused(kubectl: Kubectl, both: bool) -> None:
    [workload] = manifest("robotworkload.yaml")
    if both:
        workload["spec"]["workloadRef"] = {"kind": "Deployment", "name": "drive"}
    else:
        del workload["spec"]["template"]
    with pytest.raises(Failed, match=r"exactly one of template .* and workloadRef"):
        kubectl.apply([workload])


def test_a_policy_that_does_not_exist(kubectl: Kubectl) -> None:
    kubectl.apply(Robot(kubectl).objects(policy="no-such-policy"))
    told(kubectl, "robotworkload", "robot-1-drive", "no-such-policy")


def test_a_pool_that_selects_no_workload(kubectl: Kubectl) -> None:
    pool = next(o for o in manifest("strategies/executing.yaml") if o["kind"] == "FallbackPool")
    pool["spec"]["workloadSelector"] = {"matchLabels": {"app": "nobody"}}
    kubectl.apply([pool])
    told(kubectl, "fallbackpool", "quickstart-executing", "workload")


def test_an_image_that_cannot_start(kubectl: Kubectl) -> None:
    def wrong_image(workload: Object) -> None:
        workload["spec"]["template"]["spec"]["containers"][0]["image"] = "localhost/no-such-image:dev"

    kubectl.apply(manifest("strategies/executing.yaml"))
    kubectl.apply(Robot(kubectl).objects(policy="quickstart-executing", edit=wrong_image))
    told(kubectl, "robotworkload", "robot-1-drive", "no-such-image")


def test_an_output_type_that_is_not_installed(kubectl: Kubectl) -> None:
    def wrong_type(workload: Object) -> None:
        workload["spec"]["outputs"].append({"topic": "/gripper", "type": "my_msgs/msg/Grip"})

    kubectl.apply(manifest("strategies/executing.yaml"))
    kubectl.apply(Robot(kubectl).objects(policy="quickstart-executing", edit=wrong_type))
    told(kubectl, "robotworkload", "robot-1-drive", "my_msgs/msg/Grip", "spec.monitor.image")


def test_a_tree_that_does_not_load_names_the_path(kubectl: Kubectl) -> None:
    [policy] = [o for o in manifest("strategies/restart.yaml") if o["kind"] == "FailurePolicy"]
    policy["spec"]["monitoring"]["yaml"]["parallel"][0]["topic"]["gap"] = "500 parsecs"
    kubectl.apply([policy])
    told(kubectl, "failurepolicy", "quickstart-restart", "parallel[0].topic.gap")


def _policy_deleted(kubectl: Kubectl) -> None:
    kubectl("delete", "failurepolicy", "quickstart-executing")


def _tree_broken(kubectl: Kubectl) -> None:
    kubectl.patch(
        "failurepolicy", "quickstart-executing", {"spec": {"monitoring": {"yaml": {"parallel": None, "tpoic": {}}}}}
    )


def _lent_tree_broken(kubectl: Kubectl) -> None:
    """The policy's tree moves into a ConfigMap; once that is in force, somebody breaks it."""
    name, key = "quickstart-executing", "health.yaml"
    tree = kubectl.get("failurepolicy", name)["spec"]["monitoring"]["yaml"]
    metadata = {"name": "trees", "labels": {names.HEALTH_TREE: "true"}}
    kubectl.apply([{"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata, "data": {key: json.dumps(tree)}}])
    reference = {"name": "trees", "key": key}
    kubectl.patch("failurepolicy", name, {"spec": {"monitoring": {"yaml": None, "configMapKeyRef": reference}}})
    eventually(
        lambda: (kubectl.get("failurepolicy", name)["status"].get("tree") or {}).get("yaml") == tree,
        within=30,
        what="the ConfigMap's tree is in force",
    )
    kubectl.patch("configmap", "trees", {"data": {key: "parallel: []"}})


def _reference_to_nothing(kubectl: Kubectl) -> None:
    kubectl.patch("robotworkload", "robot-1-drive", {"spec": {"failurePolicyRef": {"name": "no-such-policy"}}})


def _template_broken(kubectl: Kubectl) -> None:
    security = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    container = {"name": "drive", "image": "localhost/no-such-image:dev", "securityContext": security}
    body = {"spec": {"template": {"spec": {"containers": [container]}}}}
    kubectl.patch("robotworkload", "robot-1-drive", body)


def complaints(robot: Robot) -> set[tuple[str, str]]:
    """The conditions of a robot's objects that say that something is wrong."""
    found = robot.kubectl.list("robotworkloads,failurepolicies")
    conditions = [(o["kind"], c) for o in found for c in (o.get("status") or {}).get("conditions") or []]
    return {(kind, c["type"]) for kind, c in conditions if c["status"] == "False" and c["type"] != "Recovering"}


@pytest.fixture
def spoilt(executing: Robot) -> Iterator[Robot]:
    """A robot whose objects a test spoils: they are as before afterwards."""
    before = complaints(executing)
    yield executing
    executing.kubectl("delete", "failurepolicy", "quickstart-executing", "--ignore-not-found")
    executing.kubectl.apply(manifest("strategies/executing.yaml"))
    executing.kubectl.apply(executing.objects(policy="quickstart-executing"))
    eventually(
        lambda: complaints(executing) <= before, within=WITHIN, what="all is well again", note=executing.describe
    )


SPOILERS = [_tree_broken, _policy_deleted, _lent_tree_broken, _reference_to_nothing, _template_broken]
"""Most of these are also tried on the API server, by tests/cluster."""


@pytest.mark.long
@pytest.mark.parametrize("spoil", SPOILERS)
def test_a_protected_workload_stays_protected_when_its_objects_become_invalid(
    spoilt: Robot, spoil: Callable[[Kubectl], None]
) -> None:
    old, before = spoilt.wait_protected(), complaints(spoilt)
    spoil(spoilt.kubectl)
    eventually(lambda: complaints(spoilt) - before, within=60, what="a condition reports it", note=spoilt.describe)
    spoilt.fail(old, "killed")
    recovery = spoilt.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing"


# -- what is only seen while it runs: nothing is wrong with how it is written ------------------------------------------

MANAGED = "managed/robotworkload.yaml"
POOL = "quickstart-initialized"
NEVER = {"sequence": [{"wait_for": {"node": "/nobody"}}]}
"""A tree that doesn't end; nothing in it says how long it may take."""


def standbys(robot: Robot) -> list[Object]:
    """Its instances that aren't in control."""
    active = robot.status().get("active")
    return [
        pod
        for pod in robot.pods()
        if pod["metadata"]["name"] != active and not pod["metadata"].get("deletionTimestamp")
    ]


def _initialize(kubectl: Kubectl, procedure: Object) -> None:
    """Give the pool another initialization."""
    change = [{"op": "replace", "path": "/spec/initialization", "value": procedure}]
    kubectl.patch("fallbackpool", POOL, change, kind_of_patch="json")


def test_a_bring_up_that_never_ends_is_reported_and_continues_once_it_is_corrected(kubectl: Kubectl) -> None:
    robot, right = Robot(kubectl), {}

    def never(workload: Object) -> None:
        right.update(workload["spec"]["bringUp"])
        workload["spec"]["bringUp"] = {"within": "3s", "yaml": NEVER}

    kubectl.apply(manifest("strategies/restart.yaml"))
    kubectl.apply(robot.objects(policy="quickstart-restart", workload=MANAGED, edit=never))
    told(
        kubectl,
        "robotworkload",
        robot.workload,
        "bringUp.sequence[0].wait_for: node /nobody is not there",
        "spec.bringUp",
    )
    kubectl.patch(
        "robotworkload",
        robot.workload,
        [{"op": "replace", "path": "/spec/bringUp", "value": right}],
        kind_of_patch="json",
    )
    robot.wait_protected()
    eventually(
        lambda: robot.condition("BroughtUp").get("status") == "True",
        within=WITHIN,
        what="what was told is taken back",
        note=robot.describe,
    )


@pytest.mark.long
def test_the_robot_is_driven_although_nothing_that_its_policy_waits_for_arrives(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    policy, pool = manifest("strategies/initialized.yaml")
    policy["spec"]["strategies"][0] |= {"recovery": {"yaml": NEVER}, "verifyWithin": "10s"}
    policy["spec"]["state"] = {
        "keep": [
            {"topic": "/nobody_talks", "type": "std_msgs/msg/String", "restoreTo": "/map"},
            {"topic": "/odom", "type": "nav_msgs/msg/Odometry", "restoreTo": "/nobody_listens"},
        ],
        "within": "2s",
    }

    def unknown_action(workload: Object) -> None:
        workload["spec"]["tasks"] = [{"action": "/dock", "type": "robots_msgs/action/Dock"}]

    kubectl.apply([policy, pool])
    kubectl.apply(robot.objects(policy=POOL, workload=MANAGED, edit=unknown_action))
    old = robot.wait_protected()
    name = robot.workload
    told(
        kubectl,
        "robotworkload",
        name,
        "spec.tasks",
        "/dock: robots_msgs/action/Dock is not installed",
        "spec.monitor.image",
    )
    told(
        kubectl,
        "robotworkload",
        name,
        "/nobody_talks: nobody publishes it",
        "state.keep[0]",
        "Correct the topic's name",
    )

    # An initialization that never ends: the standby that waits is left alone, and the one beside it tells.
    before = [pod["metadata"]["name"] for pod in standbys(robot)]
    _initialize(kubectl, {"within": "3s", "yaml": NEVER})
    told(
        kubectl,
        "robotworkload",
        name,
        "initialization.sequence[0].wait_for: node /nobody is not there",
        f"FallbackPool {POOL}",
    )
    assert set(before) < {pod["metadata"]["name"] for pod in standbys(robot)}
    assert robot.condition("Protected")["status"] == "True"

    # A recovery that never ends and a state that can't be given: the next strategy takes over, in bounded time.
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Restart", recovery
    in_vain = robot.status()["recoveries"][0]["attempts"][0]
    leaf = "strategies[0].recovery.sequence[0].wait_for: node /nobody is not there"
    assert in_vain["strategy"] == "Fallback/Initialized"
    assert in_vain["pod"] in before
    assert leaf in in_vain["message"]
    told(kubectl, "robotworkload", name, "nobody subscribes to /nobody_listens", "state.keep[1]", "restore_state")
    eventually(
        lambda: any(e["reason"] == "StrategyNotVerified" and leaf in e["message"] for e in kubectl.list("events")),
        within=30,
        what="an Event tells what was tried in vain",
        note=robot.describe,
    )

    # Corrected, the same standby strategy carries the next failure.
    kubectl.apply(manifest("strategies/initialized.yaml"))
    robot.wait_protected()
    eventually(
        lambda: robot.status().get("strategy") == "Initialized",
        within=WITHIN,
        what="the monitor counts on a standby again",
        note=robot.describe,
    )
    robot.fail(robot.wait_driven(), "killed")
    assert robot.wait_recovered(2).strategy == "Fallback/Initialized"


@pytest.mark.long
def test_no_standby_is_created_from_a_pool_that_is_not_accepted(kubectl: Kubectl) -> None:
    robot = Robot(kubectl)
    policy, pool = manifest("strategies/initialized.yaml")
    right = pool["spec"]["initialization"]
    wrong = {"yaml": {"set_lifecycle": {"node": "/drive", "state": "on"}}}
    pool["spec"]["initialization"] = wrong
    kubectl.apply([policy, pool])
    kubectl.apply(robot.objects(policy=POOL, workload=MANAGED))
    told(kubectl, "fallbackpool", POOL, "spec.initialization.yaml.set_lifecycle.state: found 'on'")
    robot.wait_driven()
    told(kubectl, "robotworkload", robot.workload, "PoolNotAccepted", "found 'on'")
    assert standbys(robot) == []
    _initialize(kubectl, right)
    robot.wait_protected()
    (standby,) = standbys(robot)

    _initialize(kubectl, wrong)
    told(kubectl, "fallbackpool", POOL, "spec.initialization.yaml.set_lifecycle.state: found 'on'")
    robot.fail(robot.wait_driven(), "killed")
    recovery = robot.wait_recovered(1)
    assert (recovery.strategy, recovery.new) == ("Fallback/Initialized", standby["metadata"]["name"])
