"""Workloads that depend on others or refer to a controller of their own, on a real API server."""

from __future__ import annotations

import json
import time

from tests.cluster.operator_objects import deployment
from tests.cluster.operators import APPS, CORE, NOWHERE, RBAC, Fleet, Operator, hot, policy, workload
from tests.support.cluster import Object, until
from understudy.api import names

# -- dependencies -------------------------------------------------------------------------------------------------------


def depending(name: str, *others: str) -> Object:
    return workload(name, dependsOn=[{"name": other} for other in others])


def may_read(fleet: Fleet, name: str) -> list[str]:
    """The workloads that a monitor may read."""
    rules = fleet.get("Role", names.monitor(name), RBAC)["rules"]
    return next(list(rule["resourceNames"]) for rule in rules if rule["resources"] == ["robotworkloads"])


def policies_read(fleet: Fleet, name: str = "w") -> list[str] | None:
    """The policies that a monitor may read; None for all."""
    rules = fleet.get("Role", names.monitor(name), RBAC)["rules"]
    return next(rule.get("resourceNames") for rule in rules if rule["resources"] == ["failurepolicies"])


def sign(fleet: Fleet, image: str) -> None:
    """What a monitor of this version says of itself."""
    said = {"status": {"monitor": {"version": "0.2.0", "image": image}}}
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), said, subresource="status")


def test_a_monitor_keeps_the_right_to_all_policies_until_its_image_reports_that_it_reads_one(
    fleet: Fleet, operator: Operator
) -> None:
    other = policy("Restart") | {"metadata": {"name": "other"}}
    fleet.create(policy("Restart"), other, workload())
    fleet.wait_built()
    assert policies_read(fleet) is None
    sign(fleet, NOWHERE)
    until(lambda: policies_read(fleet) == ["policy"], "the right to be that of its policy")
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"failurePolicyRef": {"name": "other"}}})
    until(lambda: policies_read(fleet) == ["other"], "the right to be that of its next policy")
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"monitor": {"image": f"{NOWHERE}-mine"}}})
    until(lambda: policies_read(fleet) is None, "the right to all, for an image that may be older")
    sign(fleet, f"{NOWHERE}-mine")
    until(lambda: policies_read(fleet) == ["other"], "the right to be that of its policy again")


def told_to_follow(fleet: Fleet, name: str) -> list[str]:
    """The dependencies of its workload that a monitor gets."""
    settings = json.loads(fleet.get("ConfigMap", names.settings(name), CORE)["data"]["settings.json"])
    return [one["name"] for one in settings["upstream"]]


def test_a_cycle_of_dependencies_is_reported_on_every_workload_of_the_cycle(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), depending("a", "b"), depending("b", "c"), depending("c", "a"))
    for name in "abc":
        found = fleet.wait_condition("RobotWorkload", name, "DependenciesResolved", "DependencyCycle")
        assert "a -> b -> c -> a" in found["message"]
        fleet.wait_built(name)
        assert told_to_follow(fleet, name) == [], "nothing acts on it, and each is protected by itself"
        assert may_read(fleet, name) == [name]
    fleet.cluster.patch(fleet.get("RobotWorkload", "c"), {"spec": {"dependsOn": []}})
    for name in "ab":
        fleet.wait_condition("RobotWorkload", name, "DependenciesResolved", "Resolved", "True")
    until(lambda: told_to_follow(fleet, "a") == ["c", "b"], "the monitor of a is told in which order")
    until(lambda: may_read(fleet, "a") == ["a", "b", "c"], "it may read how they are")
    until(lambda: not fleet.condition("RobotWorkload", "c", "DependenciesResolved"), "nothing is said of c any more")


def test_a_dependency_that_comes_later_is_followed_then(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), depending("planning", "localization"))
    found = fleet.wait_condition("RobotWorkload", "planning", "DependenciesResolved", "DependencyNotFound")
    assert 'no RobotWorkload "localization"' in found["message"]
    assert fleet.condition("RobotWorkload", "planning", "Accepted")["status"] == "True"
    fleet.create(workload("localization"))
    fleet.wait_condition("RobotWorkload", "planning", "DependenciesResolved", "Resolved", "True")
    fleet.cluster.delete(fleet.get("RobotWorkload", "localization"))
    fleet.wait_condition("RobotWorkload", "planning", "DependenciesResolved", "DependencyNotFound")


# -- referred controllers -----------------------------------------------------------------------------------------------


def test_a_referred_deployment_is_protected_without_a_change_to_it(fleet: Fleet, operator: Operator) -> None:
    fleet.create(deployment(), policy("hot"), hot())
    before = until(lambda: fleet.get("Deployment", "nav2", APPS), "the Deployment")
    fleet.create(workload(workloadRef={"kind": "Deployment", "name": "nav2"}))
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2, "its pod to be labelled, and a standby")
    own = next(p for p in fleet.instances() if names.POOL not in p["metadata"]["labels"])
    assert own["metadata"]["labels"][names.INSTANCE] == own["metadata"]["name"]
    fleet.cluster.delete(own)

    def relabelled() -> bool:
        found = [p for p in fleet.instances() if names.POOL not in p["metadata"]["labels"]]
        return len(found) == 1 and found[0]["metadata"]["uid"] != own["metadata"]["uid"]

    until(relabelled, "the next pod to be labelled")
    assert fleet.get("Deployment", "nav2", APPS)["spec"] == before["spec"]
    assert len(fleet.pods("app=nav2")) == 1
    fleet.cluster.delete(fleet.get("RobotWorkload", "w"))
    until(lambda: not fleet.instances(), "the labels to be taken off")
    assert len(fleet.pods("app=nav2")) == 1
    assert names.INSTANCE not in fleet.pods("app=nav2")[0]["metadata"]["labels"]


def test_labels_are_taken_off_even_if_the_workload_went_while_no_operator_ran(fleet: Fleet) -> None:
    fleet.create(deployment(), policy("Restart"), workload(workloadRef={"kind": "Deployment", "name": "nav2"}))
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        fleet.wait_built()
        until(fleet.instances, "its pod to be labelled")
    fleet.cluster.delete(fleet.get("RobotWorkload", "w"))
    assert fleet.instances()
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        until(lambda: not fleet.instances(), "the labels to be taken off")


def test_a_second_workload_that_refers_to_a_deployment_is_refused(fleet: Fleet, operator: Operator) -> None:
    reference = {"kind": "Deployment", "name": "nav2"}
    fleet.create(deployment(), policy("Restart"), workload("first", workloadRef=reference))
    fleet.wait_built("first")
    time.sleep(1.1)  # creation times have seconds
    fleet.create(workload("second", workloadRef=reference))
    found = fleet.wait_condition("RobotWorkload", "second", "Accepted", "ReferenceTaken")
    assert "first" in found["message"]
    fleet.cluster.delete(fleet.get("RobotWorkload", "first"))
    fleet.wait_condition("RobotWorkload", "second", "Accepted", "Accepted", "True")
