"""The operator against a real API server, in a namespace of its own.

Its pods are never started: those of workloads and pools name a scheduler that doesn't exist, so that the test is their
kubelet and says which are ready; the monitor's image is nowhere. What runs in them is shown by the end-to-end tests.
"""

from __future__ import annotations

import asyncio
import json
import time

import pytest

from tests.cluster.operator_objects import deployment, identities
from tests.cluster.operators import APPS, CORE, NETWORK, Fleet, Operator, hot, policy, spare, template, workload
from tests.support.cluster import Object, until
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.runtime import kopf_handlers, watches

# -- fixtures -----------------------------------------------------------------------------------------------------------


# -- building and keeping -----------------------------------------------------------------------------------------------


def test_everything_of_a_workload_appears(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot", "spare", "Restart"), hot(), spare(replicas=2), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
    until(lambda: len(fleet.held()) == 2, "two held pods")
    for kind, name in (
        ("NetworkPolicy", "w-gate"),
        ("NetworkPolicy", "w-standby"),
        ("NetworkPolicy", "spare-held"),
    ):
        assert fleet.find(kind, name, NETWORK), name
    for name in ("w-monitor", "w-discovery"):
        assert fleet.find("Deployment", name, APPS), name
    for name in ("w-robot-env", "w-robot-profiles", "w-settings"):
        assert fleet.find("ConfigMap", name, CORE), name
    address = fleet.get("Service", "w-discovery", CORE)["spec"]["clusterIP"]
    assert fleet.get("ConfigMap", "w-robot-env", CORE)["data"]["ROS_DISCOVERY_SERVER"] == f"{address}:11811"
    assert "/cmd_vel" in fleet.get("ConfigMap", "w-robot-profiles", CORE)["data"]["profiles.xml"]
    assert fleet.gate()["spec"]["podSelector"]["matchExpressions"][1]["values"] == [names.NOBODY]
    for pod in fleet.instances():
        until(
            lambda pod=pod: (
                fleet.get("Pod", pod["metadata"]["name"], CORE)["metadata"]["labels"].get(names.INSTANCE)
                == pod["metadata"]["name"]
            ),
            "every instance to be labelled with its own name",
        )
    assert fleet.get("FailurePolicy", "policy")["status"]["strategies"] == "Executing, Uninitialized, Restart"
    until(lambda: fleet.get("FailurePolicy", "policy")["status"]["workloads"] == 1, "the policy to know its workload")
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("replicas") == 2, "the pool's numbers")
    scale = fleet.cluster.get(API_VERSION, "FallbackPool", "spare", fleet.namespace, subresource="scale")
    assert (scale["spec"]["replicas"], scale["status"]["replicas"]) == (2, 2)
    settings = json.loads(fleet.get("ConfigMap", "w-settings", CORE)["data"]["settings.json"])
    assert [pool["name"] for pool in settings["pools"]] == ["hot", "spare"]
    hashes = {pod["metadata"]["labels"][names.TEMPLATE_HASH] for pod in fleet.held()}
    assert {settings["pools"][1]["templateHash"]} == hashes


def test_users_objects_get_no_finalizer_and_no_annotation(fleet: Fleet, operator: Operator) -> None:
    fleet.create(deployment(), policy("hot"), hot(), workload(workloadRef={"kind": "Deployment", "name": "nav2"}))
    fleet.wait_built()
    until(lambda: fleet.condition("FallbackPool", "hot", "Accepted"), "the pool to be looked at")
    for kind, name in (("RobotWorkload", "w"), ("FailurePolicy", "policy"), ("FallbackPool", "hot")):
        metadata = fleet.get(kind, name)["metadata"]
        assert "finalizers" not in metadata, kind
        assert "annotations" not in metadata, kind
        assert metadata["generation"] == 1, kind
    managers = {entry["manager"] for entry in fleet.get("Deployment", "nav2", APPS)["metadata"]["managedFields"]}
    assert not [manager for manager in managers if "understudy" in manager]


def test_a_deleted_pod_is_replaced_and_labelled(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot"), hot(), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
    before = fleet.instances()
    for pod in before:
        fleet.cluster.delete(pod)

    def anew() -> bool:
        found = fleet.instances()
        labelled = all(p["metadata"]["labels"].get(names.INSTANCE) == p["metadata"]["name"] for p in found)
        return len(found) == 2 and labelled and not identities(found) & identities(before)

    until(anew, "two other instances with labels")
    assert len([p for p in fleet.instances() if names.SOURCE in p["metadata"]["labels"]]) == 1


def test_deleted_and_changed_objects_are_restored(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("Restart"), workload())
    fleet.wait_built()
    standby = fleet.get("NetworkPolicy", "w-standby", NETWORK)
    fleet.cluster.delete(standby)
    until(lambda: fleet.find("NetworkPolicy", "w-standby", NETWORK), "the standby policy to come back")
    service = fleet.get("Service", "w-discovery", CORE)
    fleet.cluster.delete(service)
    again: Object = until(lambda: fleet.find("Service", "w-discovery", CORE), "the Service to come back") or {}
    assert again["spec"]["clusterIP"] == service["spec"]["clusterIP"]
    fleet.cluster.patch(fleet.get("NetworkPolicy", "w-standby", NETWORK), {"spec": {"egress": [{}]}})
    until(
        lambda: fleet.get("NetworkPolicy", "w-standby", NETWORK)["spec"]["egress"] == standby["spec"]["egress"],
        "the standby policy to be repaired",
    )


def test_a_health_tree_from_a_configmap_stays_in_force_when_a_change_is_invalid(
    fleet: Fleet, operator: Operator
) -> None:
    def tree(gap: str) -> str:
        return f"topic:\n  name: /cmd_vel\n  gap: {gap}\n"

    def in_force() -> str:
        found = (fleet.get("FailurePolicy", "policy")["status"].get("tree") or {}).get("yaml") or {}
        return str(found.get("topic", {}).get("gap"))

    found = policy("Restart")
    found["spec"]["monitoring"] = {"configMapKeyRef": {"name": "trees", "key": "health.yaml"}}
    config_map = {
        "apiVersion": CORE,
        "kind": "ConfigMap",
        "metadata": {"name": "trees"},
        "data": {"health.yaml": tree("1s")},
    }
    fleet.create(config_map, found, workload())
    told = fleet.wait_condition("FailurePolicy", "policy", "Accepted", "TreeNotFound")
    assert f"kubectl label configmap -n {fleet.namespace} trees {names.HEALTH_TREE}=true" in told["message"]
    config_map = fleet.get("ConfigMap", "trees", CORE)
    begun = time.monotonic()
    fleet.cluster.patch(config_map, {"metadata": {"labels": {names.HEALTH_TREE: "true"}}})
    fleet.wait_condition("FailurePolicy", "policy", "Accepted", "Accepted", "True")
    until(lambda: in_force() == "1s", "the tree to be in force")
    assert time.monotonic() - begun < 20, "a list of everything comes only every half minute"
    fleet.wait_built()
    fleet.cluster.patch(config_map, {"data": {"health.yaml": tree("2s")}})
    until(lambda: in_force() == "2s", "the changed tree to be in force")
    fleet.cluster.patch(config_map, {"data": {"health.yaml": tree("2 moons")}})
    told = fleet.wait_condition("FailurePolicy", "policy", "Accepted", "TreeInvalid")
    assert "ConfigMap trees, health.yaml, line 3, column 3: topic.gap: '2 moons' is not a duration" in told["message"]
    fleet.cluster.delete(config_map)
    fleet.wait_condition("FailurePolicy", "policy", "Accepted", "TreeNotFound")
    assert in_force() == "2s"


def test_control_stays_when_the_rules_or_the_labels_of_a_gate_change(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot"), hot(), workload())
    fleet.wait_built()
    pod = fleet.instances()[0]
    fleet.commit(pod)
    committed = fleet.gate()
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"gate": {"robots": ["192.168.7.0/24"]}}})
    until(
        lambda: "192.168.7.0/24" in json.dumps(fleet.get("NetworkPolicy", "w-standby", NETWORK)["spec"]),
        "the change to be reconciled",
    )
    until(lambda: "192.168.7.0/24" in json.dumps(fleet.gate()["spec"]["egress"]), "the rules of the gate")
    fleet.cluster.patch(fleet.gate(), {"metadata": {"labels": {"app.kubernetes.io/managed-by": None}}})
    until(lambda: fleet.gate()["metadata"].get("labels"), "its label to be repaired", seconds=40)
    repaired = fleet.gate()
    assert repaired["spec"]["podSelector"] == committed["spec"]["podSelector"]
    assert repaired["metadata"]["annotations"] == committed["metadata"]["annotations"]


def test_a_restart_of_the_operator_changes_nothing(fleet: Fleet) -> None:
    fleet.create(policy("hot", "spare"), hot(), spare(), workload())
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        fleet.wait_built()
        until(lambda: len(fleet.instances()) == 2 and len(fleet.held()) == 2, "all pods")
        until(
            lambda: (fleet.get("FallbackPool", "spare").get("status") or {}).get("replicas") == 2, "the pool's numbers"
        )
        fleet.commit(fleet.instances()[0])
        before = fleet.settled()
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=1):
        time.sleep(5)
        assert fleet.versions() == before


def test_a_new_template_replaces_standbys_one_after_the_other(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot"), hot(per_workload=2), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 3, "one pod and two standbys")
    for pod in fleet.instances():
        fleet.make_ready(pod)
    active = next(p for p in fleet.instances() if names.SOURCE in p["metadata"]["labels"])
    standbys = [p for p in fleet.instances() if names.POOL in p["metadata"]["labels"]]
    fleet.commit(active)
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"template": template(args=["--new"])}})
    until(lambda: len(fleet.instances()) == 5, "two new standbys beside the old ones")
    assert identities(standbys) <= identities(fleet.instances())
    assert "args" not in fleet.get("ReplicaSet", "w", APPS)["spec"]["template"]["spec"]["containers"][0]
    new = [p for p in fleet.instances() if p["metadata"]["uid"] not in identities([active, *standbys])]
    fleet.make_ready(new[0])
    until(lambda: len(fleet.instances()) == 4, "one old standby to go")
    fleet.make_ready(new[1])
    until(lambda: len(fleet.instances()) == 3, "the other old standby to go")
    assert identities(fleet.instances()) == identities([active, *new])
    until(
        lambda: "args" in fleet.get("ReplicaSet", "w", APPS)["spec"]["template"]["spec"]["containers"][0],
        "the ReplicaSet to take the template that has proved itself",
    )


def test_lists_find_the_changes_that_silent_watches_miss(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    async def silent(*_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(kopf_handlers, "watch", silent)
    monkeypatch.setattr(watches, "watch", silent)
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=0.5):
        fleet.create(policy("hot"), hot(), workload())
        fleet.wait_built()
        until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
        fleet.cluster.delete(next(p for p in fleet.instances() if names.POOL in p["metadata"]["labels"]))
        until(lambda: len(fleet.instances()) == 2, "another standby")
