"""Bad input: a condition and an Event that say what to do; nothing crashes, and what is protected stays protected."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import Robot, eventually, manifest


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

    eventually(condition, within=60, what=f"a condition of {kind} {name} says {words}", note=note)
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


def _reference_to_nothing(kubectl: Kubectl) -> None:
    kubectl.patch("robotworkload", "robot-1-drive", {"spec": {"failurePolicyRef": {"name": "no-such-policy"}}})


def _template_broken(kubectl: Kubectl) -> None:
    body = {"spec": {"template": {"spec": {"containers": [{"name": "drive", "image": "localhost/no-such-image:dev"}]}}}}
    kubectl.patch("robotworkload", "robot-1-drive", body)


@pytest.mark.parametrize("spoil", [_policy_deleted, _tree_broken, _reference_to_nothing, _template_broken])
def test_what_is_protected_stays_protected(executing: Robot, spoil: Callable[[Kubectl], None]) -> None:
    old = executing.wait_protected()
    spoil(executing.kubectl)
    eventually(
        lambda: (
            [c for c in executing.status()["conditions"] if c["status"] == "False" and c["type"] != "Recovering"]
            or any(
                c["status"] == "False"
                for p in executing.kubectl.list("failurepolicies")
                for c in p.get("status", {}).get("conditions", [])
            )
        ),
        within=60,
        what="a condition tells of it",
        note=executing.describe,
    )
    executing.fail(old, "killed")
    recovery = executing.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing"
