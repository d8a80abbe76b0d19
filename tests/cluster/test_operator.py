"""The operator against a real API server, in a namespace of its own.

Its pods are never started: those of workloads and pools name a scheduler that doesn't exist, so that the test is their
kubelet and says which are ready; the monitor's image is nowhere. What runs in them is shown by the end-to-end tests.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.cluster.operators import (
    APPS,
    BUILT,
    CORE,
    NETWORK,
    NOWHERE,
    POLICY,
    RBAC,
    Fleet,
    Operator,
    alone,
    custom,
    fleet,
    hot,
    leader,
    operator,
    policy,
    process,
    ready,
    spare,
    template,
    workload,
)
from tests.support.cluster import Cluster, Object, Refused, until
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.cli.plan import size
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects
from understudy.controller.runtime import kopf_handlers, watches
from understudy.controller.runtime import process as running

OURS = "app.kubernetes.io/managed-by=understudy"

# -- what users write ---------------------------------------------------------------------------------------------------

__all__ = ["alone", "fleet", "operator"]  # fixtures


def deployment(name: str = "nav2", replicas: int = 1) -> Object:
    pods = template()
    pods["metadata"]["labels"] = {"app": name}
    spec = {"replicas": replicas, "selector": {"matchLabels": {"app": name}}, "template": pods}
    return {"apiVersion": APPS, "kind": "Deployment", "metadata": {"name": name}, "spec": spec}


# -- looking and touching -----------------------------------------------------------------------------------------------


def identities(items: list[Object]) -> set[str]:
    return {item["metadata"]["uid"] for item in items}


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
    assert fleet.gate()["spec"]["podSelector"]["matchLabels"][names.INSTANCE] == names.GATE_CLOSED
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


def test_what_somebody_deletes_or_changes_comes_back(fleet: Fleet, operator: Operator) -> None:
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


def test_a_health_tree_of_a_config_map_is_in_force_while_a_broken_change_is_told(
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


def test_a_gate_that_was_committed_to_is_left_alone(fleet: Fleet, operator: Operator) -> None:
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
    assert fleet.gate()["metadata"]["resourceVersion"] == committed["metadata"]["resourceVersion"]
    fleet.cluster.patch(committed, {"metadata": {"labels": {"app.kubernetes.io/managed-by": None}}})
    until(lambda: fleet.gate()["metadata"].get("labels"), "its label to be repaired", seconds=40)
    repaired = fleet.gate()
    assert repaired["spec"] == committed["spec"]
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


def claimed_from_a_pool(fleet: Fleet, *, replicas: int) -> Object:
    """A pod that workload w has claimed and that drives it; its pool is filled again."""
    fleet.create(policy("spare", "Restart"), spare(replicas=replicas), workload())
    fleet.wait_built()
    until(lambda: len(fleet.held()) == replicas, "the pool to be filled")
    claimed = fleet.held()[0]
    fleet.make_ready(claimed)
    claimed = fleet.get("Pod", claimed["metadata"]["name"], CORE)
    fleet.claim(claimed)
    fleet.commit(claimed)
    until(lambda: len(fleet.held()) == replicas, "the pool to be refilled")
    return claimed


def test_claimed_pods_belong_to_their_workload_and_the_pool_is_refilled(fleet: Fleet, operator: Operator) -> None:
    claimed = claimed_from_a_pool(fleet, replicas=2)
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("claimed") == 1, "the claim to be counted")
    # a claimed pod drives and nobody wants another as a standby
    until(lambda: fleet.get("ReplicaSet", "w", APPS)["spec"]["replicas"] == 0, "the workload's own pod to go")
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"replicas": 0}})
    until(lambda: not fleet.held(), "the pool to be emptied")
    token = fleet.get("Secret", names.pool_secret("spare"), CORE)
    fleet.cluster.delete(fleet.get("FallbackPool", "spare"))
    time.sleep(3)
    assert claimed["metadata"]["uid"] in identities(fleet.instances())
    assert fleet.get("Secret", names.pool_secret("spare"), CORE)["metadata"]["uid"] == token["metadata"]["uid"]
    assert "spare" in monitor_deployment.commanded(fleet.get("Role", names.monitor("w"), RBAC))
    fleet.cluster.delete(fleet.get("Pod", claimed["metadata"]["name"], CORE))
    until(lambda: fleet.get("ReplicaSet", "w", APPS)["spec"]["replicas"] == 1, "the workload's own pod to come back")
    until(lambda: fleet.find("Secret", names.pool_secret("spare"), CORE) is None, "its agent's token to go")
    until(
        lambda: "spare" not in monitor_deployment.commanded(fleet.get("Role", names.monitor("w"), RBAC)),
        "the right to go",
    )


def test_a_pool_that_is_deleted_without_an_operator_leaves_the_token_of_a_claimed_pod(fleet: Fleet) -> None:
    def token() -> Object | None:
        return fleet.find("Secret", names.pool_secret("spare"), CORE)

    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        claimed = claimed_from_a_pool(fleet, replicas=1)
    before = token()
    assert before is not None
    fleet.cluster.delete(fleet.get("FallbackPool", "spare"))
    until(lambda: not fleet.held(), "what is the pool's to be collected", seconds=60)
    time.sleep(5)
    assert (token() or {}).get("metadata", {}).get("uid") == before["metadata"]["uid"]
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        fleet.wait_condition("FailurePolicy", "policy", "Accepted", "PoolNotFound")
        assert (token() or {}).get("metadata", {}).get("uid") == before["metadata"]["uid"]
        fleet.cluster.delete(fleet.get("Pod", claimed["metadata"]["name"], CORE))
        until(lambda: token() is None, "the token that nobody needs to go")


def test_the_token_that_a_pool_of_an_earlier_version_owns_is_taken_from_it(fleet: Fleet) -> None:
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=1):
        fleet.create(spare(replicas=0))
        token = until(lambda: fleet.find("Secret", names.pool_secret("spare"), CORE), "its token")
        assert token is not None
        owner = kube_objects.owner("FallbackPool", fleet.get("FallbackPool", "spare"))
        fleet.cluster.patch(token, {"metadata": {"ownerReferences": [owner], "labels": {names.POOL: None}}})

        def released() -> bool:
            metadata = fleet.get("Secret", names.pool_secret("spare"), CORE)["metadata"]
            return not metadata.get("ownerReferences") and metadata["labels"].get(names.POOL) == "spare"

        until(released, "it to be nobody's")
        assert fleet.get("Secret", names.pool_secret("spare"), CORE)["data"] == token["data"]


def test_a_pool_is_never_overfilled_while_pods_come_and_go(fleet: Fleet, operator: Operator) -> None:
    fleet.create(spare(replicas=4), workload(), policy("spare"))
    most, begun = 0, time.monotonic()
    full: float | None = None  # when it first was
    while (now := time.monotonic()) < (begun + 60 if full is None else full + 8):
        found = fleet.held()
        most = max(most, len(found))
        if len(found) == 4:
            full = full or now
            fleet.cluster.delete(found[0])
            fleet.cluster.patch(
                fleet.get("FallbackPool", "spare"), {"metadata": {"labels": {"n": str(time.time_ns())}}}
            )
    assert most == 4


def test_a_pool_s_size_follows_the_failures_that_its_robots_status_tells_of(
    fleet: Fleet, operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    sizing = {"risk": "1%", "failuresPerRobotHour": 1, "refill": "10m", "max": 5}
    pool = spare(sizing=sizing)
    del pool["spec"]["replicas"]
    fleet.create(policy("spare"), pool, workload())
    assumed = until(lambda: (fleet.get("FallbackPool", "spare").get("status") or {}).get("sizing"), "a size")
    assert (assumed["size"], assumed["failures"], assumed["robots"]) == (3, 0, 1)
    asked = ("--robots=1", "--failures-per-robot-hour=1", "--recovery-seconds=2", "--refill-seconds=600", "--risk=0.01")
    assert size.main([*asked, "-o", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["needed"]["loss"] == assumed["size"], "understudy size comes to the same"
    until(lambda: len(fleet.held()) == 3, "the pods that it asks for")
    detected = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + 1))
    time.sleep(2)
    attempts = [{"strategy": "Fallback/Uninitialized", "pod": "spare-abcde", "result": "Verified"}]
    recovery = {"reason": "it ended", "result": "Recovered", "moments": {"detected": detected}, "attempts": attempts}
    failed = {"recoveryCount": 10, "recoveries": [{"id": str(number), **recovery} for number in range(10)]}
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"status": failed}, subresource="status")
    until(lambda: len(fleet.held()) == 5, "as many as there may be")
    found = fleet.wait_condition("FallbackPool", "spare", "Sized", "AtMaximum")
    assert "asked for a pod 10 times" in found["message"]
    assert "spec.sizing.max is 5" in found["message"]
    told = until(lambda: fleet.told("spare", "Resized"), "an Event, which comes after the status")
    assert [event["message"].partition(":")[0] for event in told] == ["from 3 to 5 pods"]
    before = fleet.settled()
    operator.stop()
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        assert fleet.settled() == before


def test_a_new_template_of_a_pool_leaves_as_many_ready_as_it_says(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("spare"), spare(replicas=3, updateStrategy={"minReady": 2}), workload())
    until(lambda: len(fleet.held()) == 3, "three held pods")
    old = fleet.held()
    for pod in old:
        fleet.make_ready(pod)
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("ready") == 3, "all of them to be ready")
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"template": template(args=["--new"])}})
    until(lambda: len(fleet.held()) == 5, "three new ones, and two of the old ones")
    new = [pod for pod in fleet.held() if pod["metadata"]["uid"] not in identities(old)]
    assert len(new) == 3
    until(
        lambda: (
            "2 of 5 unclaimed pods" in fleet.wait_condition("FallbackPool", "spare", "Updated", "RollingOut")["message"]
        ),
        "what is so to be told",
    )
    fleet.make_ready(new[0])
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("updated") == 3, "its numbers")
    time.sleep(2)
    assert len(fleet.held()) == 5
    assert fleet.get("FallbackPool", "spare")["status"]["ready"] == 2, "those of the old template"
    fleet.make_ready(new[1])
    until(lambda: identities(fleet.held()) == identities(new), "the old ones to go")
    fleet.wait_condition("FallbackPool", "spare", "Updated", "Updated", "True")


def test_on_replenish_pods_of_an_old_template_wait_on_and_may_be_claimed(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("spare"), spare(replicas=2, updateStrategy={"type": "OnReplenish"}), workload())
    fleet.wait_built()
    until(lambda: len(fleet.held()) == 2, "two held pods")
    old = fleet.held()
    for pod in old:
        fleet.make_ready(pod)
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"template": template(args=["--new"])}})
    fleet.wait_condition("FallbackPool", "spare", "Updated", "OnReplenish", "True")
    assert identities(fleet.held()) == identities(old)
    assert fleet.get("FallbackPool", "spare")["status"]["ready"] == 2
    settings = json.loads(fleet.get("ConfigMap", "w-settings", CORE)["data"]["settings.json"])
    assert settings["pools"][0].get("templateHash", "") == ""
    claimed = fleet.get("Pod", old[0]["metadata"]["name"], CORE)
    fleet.claim(claimed)
    fleet.commit(claimed)
    until(lambda: len(fleet.held()) == 2, "another in its place")
    (new,) = [pod for pod in fleet.held() if pod["metadata"]["uid"] not in identities(old)]
    assert new["metadata"]["labels"][names.TEMPLATE_HASH] != old[0]["metadata"]["labels"][names.TEMPLATE_HASH]


@pytest.fixture
def nodes(cluster: Cluster) -> Iterator[list[Object]]:
    """Two nodes that nothing runs on, and that no scheduler takes: pods of other tests would wait there for ever."""
    taint = {"key": "understudy.dev/test", "effect": "NoSchedule"}
    made = []
    stop = threading.Event()

    def beat() -> None:
        """What kubelets say again and again, or Kubernetes takes their nodes as lost, here after 6 s."""
        begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        ready = {"type": "Ready", "status": "True", "reason": "Test", "message": "", "lastTransitionTime": begun}
        while True:
            moment = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            for node in made:
                said = {"status": {"conditions": [ready | {"lastHeartbeatTime": moment}]}}
                cluster.patch(node, said, subresource="status")
            if stop.wait(1):
                return

    for number in range(2):
        name = f"understudy-{uuid.uuid4().hex[:6]}-{number}"
        node = {"apiVersion": CORE, "kind": "Node", "metadata": {"name": name}, "spec": {"taints": [taint]}}
        made.append(cluster.create(node))
        cluster.patch(made[-1], {"spec": {"taints": [taint]}})
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    yield made
    stop.set()
    thread.join(40)
    for node in made:
        cluster.delete(node)


def test_pods_on_a_node_that_is_to_be_emptied_are_replaced_before_they_go(
    fleet: Fleet, operator: Operator, nodes: list[Object]
) -> None:
    def place(pod: Object, node: Object) -> None:
        """What a scheduler does, and then a kubelet."""
        target = {"apiVersion": CORE, "kind": "Node", "name": node["metadata"]["name"]}
        body = {"apiVersion": CORE, "kind": "Binding", "metadata": {"name": pod["metadata"]["name"]}, "target": target}
        path = fleet.cluster.path(CORE, "Pod", fleet.namespace, pod["metadata"]["name"], "binding")
        fleet.cluster.request("POST", path, body=body)
        fleet.make_ready(pod)

    def evict(pod: Object) -> None:
        """What ``kubectl drain`` asks for."""
        metadata = {"name": pod["metadata"]["name"], "namespace": fleet.namespace}
        path = fleet.cluster.path(CORE, "Pod", fleet.namespace, pod["metadata"]["name"], "eviction")
        fleet.cluster.request("POST", path, body={"apiVersion": POLICY, "kind": "Eviction", "metadata": metadata})

    fleet.create(policy("spare"), spare(replicas=1), workload())
    (old,) = until(fleet.held, "a held pod")
    place(old, nodes[0])
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("ready") == 1, "it to be ready")
    fleet.cluster.patch(nodes[0], {"spec": {"unschedulable": True}})
    until(lambda: len(fleet.held()) == 2, "another one beside it")
    with pytest.raises(Refused, match="disruption budget") as refused:
        evict(old)
    assert refused.value.status == 429
    assert identities([old]) <= identities(fleet.held())
    found = fleet.wait_condition("FallbackPool", "spare", "Moving", "NodeLeaves", "True")
    assert nodes[0]["metadata"]["name"] in found["message"]
    (new,) = [pod for pod in fleet.held() if pod["metadata"]["uid"] != old["metadata"]["uid"]]
    place(new, nodes[1])
    until(lambda: identities(fleet.held()) == identities([new]), "the one on the cordoned node to go")
    until(lambda: not fleet.condition("FallbackPool", "spare", "Moving"), "that to be over")


def test_silent_watches_are_made_up_for_by_lists(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
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


# -- protection ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def protected(fleet: Fleet, operator: Operator) -> Fleet:
    """A workload with an active pod, a ready standby and a monitor."""
    fleet.create(policy("hot", "Restart"), hot(), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
    for pod in fleet.instances():
        fleet.make_ready(pod)
    fleet.make_parts_ready()
    fleet.commit(next(p for p in fleet.instances() if names.SOURCE in p["metadata"]["labels"]))
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    return fleet


def test_protected_says_by_what_and_stops_saying_so(protected: Fleet) -> None:
    assert protected.get("RobotWorkload", "w")["status"]["standby"] == "Executing (1/1)"
    standby = next(p for p in protected.instances() if names.POOL in p["metadata"]["labels"])
    protected.make_ready(standby, ready=False)
    found = protected.wait_condition("RobotWorkload", "w", "Protected", "StandbyNotReady")
    assert "If it failed now, Restart would be used" in found["message"]
    until(lambda: protected.told("w", "StandbyNotReady", "Warning"), "an Event, which comes after the status")
    protected.make_ready(standby)
    protected.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")


def _delete_policy(fleet: Fleet) -> None:
    fleet.cluster.delete(fleet.get("FailurePolicy", "policy"))


def _break_tree(fleet: Fleet) -> None:
    tree = {"monitoring": {"yaml": {"topic": None, "topik": {"name": "/x"}}}}
    fleet.cluster.patch(fleet.get("FailurePolicy", "policy"), {"spec": tree})


def _break_template(fleet: Fleet) -> None:
    bad = template(resources={"requests": {"cpu": "plenty"}})
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"spec": {"template": bad}})


@pytest.mark.parametrize(
    ("harm", "reason", "word"),
    [
        (_delete_policy, "PolicyNotFound", '"policy"'),
        (_break_tree, "PolicyNotAccepted", "topik"),
        (_break_template, "TemplateInvalid", "quantities must match"),
    ],
)
def test_bad_input_takes_nothing_away(protected: Fleet, harm: Callable[[Fleet], None], reason: str, word: str) -> None:
    settings = protected.get("ConfigMap", "w-settings", CORE)["data"]
    gate, pods = protected.gate(), identities(protected.instances())
    harm(protected)
    found = protected.wait_condition("RobotWorkload", "w", "Accepted", reason)
    assert word in found["message"]
    until(lambda: protected.told("w", reason), "an Event")
    time.sleep(1)
    assert identities(protected.instances()) == pods
    assert protected.gate()["spec"] == gate["spec"]
    assert protected.get("ConfigMap", "w-settings", CORE)["data"] == settings
    assert protected.find("NetworkPolicy", "w-standby", NETWORK)
    assert protected.find("Deployment", "w-monitor", APPS)


# -- bad input ----------------------------------------------------------------------------------------------------------


def foreign_gate() -> Object:
    spec = {"podSelector": {"matchLabels": {"mine": "yes"}}, "policyTypes": ["Ingress"]}
    return {"apiVersion": NETWORK, "kind": "NetworkPolicy", "metadata": {"name": "w-gate"}, "spec": spec}


def unheld() -> Object:
    found = template()
    del found["spec"]["containers"][0]["command"]
    return found


def started(**container: Any) -> Object:
    found = template(**container)
    del found["spec"]["schedulerName"]
    return found


BAD = {
    "a policy that does not exist": (
        [workload(failurePolicyRef={"name": "polcy"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "PolicyNotFound"),
        'did you mean "policy"?',
    ),
    "a tree that can not be read": (
        [policy("Restart", yaml={"topik": {"name": "/cmd_vel"}})],
        ("FailurePolicy", "policy", "Accepted", "TreeInvalid"),
        "spec.monitoring.yaml",
    ),
    "a strategy whose pool does not exist": (
        [policy("hott"), hot()],
        ("FailurePolicy", "policy", "Accepted", "PoolNotFound"),
        'did you mean "hot"?',
    ),
    "a pool with no matching workload": (
        [spare(replicas=1)],
        ("FallbackPool", "spare", "Ready", "NoMatchingWorkload"),
        "task=critical",
    ),
    "an initialization with a mistake": (
        [
            custom(
                "FallbackPool",
                "warm",
                {
                    "readiness": "Initialized",
                    "perWorkload": 1,
                    "workloadSelector": {},
                    "initialization": {"yaml": {"set_lifecycle": {"node": "amcl", "state": "inactive"}}},
                },
            )
        ],
        ("FallbackPool", "warm", "Accepted", "TreeInvalid"),
        "spec.initialization.yaml.set_lifecycle.node: found 'amcl'; did you mean '/amcl'?",
    ),
    "a bringUp with a mistake": (
        [workload(bringUp={"yaml": {"call_servise": {}}}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "TreeInvalid"),
        "spec.bringUp.yaml.call_servise: unknown key 'call_servise', did you mean 'call_service'?",
    ),
    "a held template without a command": (
        [workload(template=unheld()), policy("spare"), spare(templateFrom={"workload": "w"})],
        ("FallbackPool", "spare", "Accepted", "TemplateInvalid"),
        "command",
    ),
    "a template taken from nowhere": (
        [spare(templateFrom={"workload": "gone"})],
        ("FallbackPool", "spare", "Accepted", "TemplateSourceNotFound"),
        '"gone"',
    ),
    "a pod template that the API server refuses": (
        [workload(template=template(resources={"requests": {"cpu": "plenty"}})), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "TemplateInvalid"),
        "quantities must match",
    ),
    "a pool template that the API server refuses": (
        [spare(template=template(ports=[{"containerPort": 99999}]))],
        ("FallbackPool", "spare", "Accepted", "TemplateInvalid"),
        "containerPort",
    ),
    "a controller that does not exist": (
        [workload(workloadRef={"kind": "Deployment", "name": "nav2"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "ReferenceNotFound"),
        'no Deployment "nav2"',
    ),
    "a controller with two pods": (
        [deployment(replicas=2), workload(workloadRef={"kind": "Deployment", "name": "nav2"}), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "ReplicasNotOne"),
        "spec.replicas is 2",
    ),
    "a name that belongs to somebody else": (
        [foreign_gate(), workload(), policy("Restart")],
        ("RobotWorkload", "w", "Accepted", "NameTaken"),
        'NetworkPolicy "w-gate"',
    ),
    "an image that can not start": (
        [workload(template=started()), policy("Restart")],
        ("RobotWorkload", "w", "Protected", "ErrImageNeverPull"),
        NOWHERE,
    ),
    "a pool's image that can not start": (
        [spare(replicas=1, template=started()), workload(), policy("spare")],
        ("FallbackPool", "spare", "Ready", "ErrImageNeverPull"),
        "imagePullPolicy is Never",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_a_condition_and_an_event_that_say_what_to_do(
    case: str, fleet: Fleet, operator: Operator
) -> None:
    items, (kind, name, type_, reason), words = BAD[case]
    fleet.create(*items)
    if type_ == "Protected":
        fleet.make_parts_ready()
    found = fleet.wait_condition(kind, name, type_, reason)
    assert words in found["message"]

    event: Object = until(lambda: fleet.told(name, reason, "Warning"), f"an Event {reason}")[0]
    assert words in event["message"]
    if case == "a name that belongs to somebody else":
        assert fleet.gate()["spec"]["podSelector"] == {"matchLabels": {"mine": "yes"}}
        assert "ownerReferences" not in fleet.gate()["metadata"]


def test_bad_input_that_is_put_right_is_accepted(fleet: Fleet, operator: Operator) -> None:
    fleet.create(workload())
    fleet.wait_condition("RobotWorkload", "w", "Accepted", "PolicyNotFound")
    fleet.create(policy("Restart"))
    fleet.wait_condition("RobotWorkload", "w", "Accepted", "Accepted", "True")


def test_one_bad_object_does_not_keep_another_from_being_protected(fleet: Fleet, operator: Operator) -> None:
    fleet.create(workload("bad", failurePolicyRef={"name": "gone"}), policy("hot"), hot(), workload("good"))
    fleet.wait_built("good")
    until(lambda: len(fleet.instances("good")) == 2, "pod and standby of the good one")


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


def test_a_monitor_keeps_the_right_to_all_policies_until_its_image_has_said_that_it_asks_by_name(
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


def test_a_circle_of_dependencies_is_told_on_every_workload_in_it_until_one_is_taken_out(
    fleet: Fleet, operator: Operator
) -> None:
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


def test_the_second_to_refer_to_a_deployment_is_told(fleet: Fleet, operator: Operator) -> None:
    reference = {"kind": "Deployment", "name": "nav2"}
    fleet.create(deployment(), policy("Restart"), workload("first", workloadRef=reference))
    fleet.wait_built("first")
    time.sleep(1.1)  # creation times have seconds
    fleet.create(workload("second", workloadRef=reference))
    found = fleet.wait_condition("RobotWorkload", "second", "Accepted", "ReferenceTaken")
    assert "first" in found["message"]
    fleet.cluster.delete(fleet.get("RobotWorkload", "first"))
    fleet.wait_condition("RobotWorkload", "second", "Accepted", "Accepted", "True")


# -- the end ------------------------------------------------------------------------------------------------------------


def test_nothing_is_left_of_a_deleted_workload_and_pool(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("hot", "spare"), hot(), spare(), workload())
    fleet.wait_built()
    until(lambda: len(fleet.instances()) == 2 and len(fleet.held()) == 2, "all pods")
    for kind, name in (
        ("RobotWorkload", "w"),
        ("FallbackPool", "hot"),
        ("FallbackPool", "spare"),
        ("FailurePolicy", "policy"),
    ):
        fleet.cluster.delete(fleet.get(kind, name))

    def left() -> list[str]:
        found = [
            f"{kind}/{item['metadata']['name']}"
            for api_version, kind in BUILT
            for item in fleet.cluster.list(api_version, kind, fleet.namespace, labels=OURS)
        ]
        return found + [pod["metadata"]["name"] for pod in fleet.pods(names.COMPONENT)]

    until(lambda: not left(), "nothing to be left", seconds=30)
    time.sleep(2)
    assert left() == []


def test_a_namespace_is_deleted_with_everything_in_it(cluster: Cluster) -> None:
    name = f"test-{uuid.uuid4().hex[:8]}"
    item = cluster.create({"apiVersion": CORE, "kind": "Namespace", "metadata": {"name": name}})
    fleet = Fleet(cluster, name)
    # the operator's Lease is elsewhere: a namespace's deletion mustn't end it
    with Operator(cluster.kubeconfig, name):
        fleet.create(policy("hot", "spare"), hot(), spare(), workload())
        fleet.wait_built()
        cluster.delete(item)
        until(lambda: cluster.find(CORE, "Namespace", name) is None, "the namespace to be gone", seconds=60)


# -- leadership ---------------------------------------------------------------------------------------------------------


def test_of_two_candidates_one_leads_and_the_other_follows_a_kill(fleet: Fleet) -> None:
    with ExitStack() as stack:
        processes = {identity: stack.enter_context(process(fleet, identity)) for identity in ("one", "two")}
        first = until(lambda: leader(fleet), "a leader", seconds=60)
        fleet.create(policy("hot"), hot(), workload())
        fleet.wait_built()
        until(lambda: len(fleet.instances()) == 2, "one pod and one standby")
        before = fleet.settled()
        processes[first].kill()
        killed = time.monotonic()
        second = until(lambda: leader(fleet) not in ("", first) and leader(fleet), "another leader", seconds=30)
        assert second in processes
        assert time.monotonic() - killed < 25
        time.sleep(2)
        assert fleet.versions() == before
        fleet.cluster.delete(next(p for p in fleet.instances() if names.POOL in p["metadata"]["labels"]))
        until(lambda: len(fleet.instances()) == 2, "another standby, made by the new leader")


def test_a_leader_that_is_told_to_end_hands_over_at_once(fleet: Fleet) -> None:
    with process(fleet, "one") as one:
        until(lambda: leader(fleet) == "one", "a leader", seconds=60)
        with socket.create_server(("", 0)) as free:
            port: int = free.getsockname()[1]
        with process(fleet, "two", port):
            until(lambda: ready(port), "the other one to be ready", seconds=60)
            one.send_signal(signal.SIGTERM)
            assert one.wait(20) == 0
            until(lambda: leader(fleet) == "two", "the other to lead", seconds=6)


def test_a_lost_lease_ends_the_process(fleet: Fleet) -> None:
    with process(fleet, "one") as one:
        until(lambda: leader(fleet) == "one", "a leader", seconds=60)
        lease = fleet.cluster.get("coordination.k8s.io/v1", "Lease", running.LEASE, fleet.namespace)
        fleet.cluster.patch(lease, {"spec": {"holderIdentity": "thief", "leaseDurationSeconds": 60}})
        assert one.wait(20) == 1
        assert leader(fleet) == "thief"


def test_an_operator_that_does_not_lead_writes_nothing(fleet: Fleet) -> None:
    lease = {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": running.LEASE},
        "spec": {"holderIdentity": "other", "leaseDurationSeconds": 600},
    }
    fleet.create(lease, policy("hot"), hot(), workload())
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=1):
        time.sleep(4)
        assert "status" not in fleet.get("RobotWorkload", "w")
        with pytest.raises(Refused):
            fleet.gate()


# -- degraded -----------------------------------------------------------------------------------------------------------


def degrading(action: Object, *strategies: str) -> Object:
    made = policy(*strategies)
    well = {"yaml": {"topic": {"name": "/cmd_vel", "rate": "> 18 Hz"}}}
    made["spec"]["degraded"] = {"monitoring": well, "actions": [action]}
    return made


def say_degraded(fleet: Fleet, so: bool) -> None:
    """What the monitor says."""
    said = {
        "type": "Degraded",
        "status": "True" if so else "False",
        "reason": "NotWell" if so else "Well",
        "message": "",
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }
    status = {"health": "Degraded" if so else "Healthy", "conditions": [said]}
    item = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": {"name": "w"}, "status": status}
    fleet.cluster.apply(item, fleet.namespace, subresource="status", manager="understudy-monitor")


def in_control(fleet: Fleet) -> str:
    """Put the workload's own pod in control; its name."""
    fleet.wait_built()
    fleet.make_parts_ready()
    (pod,) = until(fleet.instances, "the workload's own pod")
    fleet.make_ready(pod)
    fleet.commit(pod)
    name: str = pod["metadata"]["name"]
    return name


def cpu(fleet: Fleet, pod: str) -> tuple[str, str]:
    """The request and the limit of a pod's first container."""
    resources = fleet.get("Pod", pod, CORE)["spec"]["containers"][0]["resources"]
    return resources["requests"]["cpu"], resources["limits"]["cpu"]


def test_the_pod_in_control_gets_more_while_its_workload_is_degraded(fleet: Fleet, operator: Operator) -> None:
    resources = {"requests": {"cpu": "50m"}, "limits": {"cpu": "200m"}}
    asked = degrading({"resize": {"cpu": "300m"}}, "Restart")
    fleet.create(asked, workload(template=template(resources=resources)))
    pod = in_control(fleet)
    uid = fleet.get("Pod", pod, CORE)["metadata"]["uid"]
    say_degraded(fleet, False)
    time.sleep(2)
    assert cpu(fleet, pod) == ("50m", "200m"), "nothing is done while all is well"
    say_degraded(fleet, True)
    until(lambda: cpu(fleet, pod) == ("300m", "300m"), "it to have more")
    fleet.wait_condition("RobotWorkload", "w", "Resized", "Resized", "True")
    assert fleet.settled() == fleet.settled(), "and that is done once"
    say_degraded(fleet, False)
    until(lambda: not fleet.condition("RobotWorkload", "w", "Resized"), "nothing to be said of it any more")
    assert cpu(fleet, pod) == ("300m", "300m"), "what it has it keeps"
    assert fleet.get("Pod", pod, CORE)["metadata"]["uid"] == uid


def test_what_the_api_server_does_not_take_is_told_and_leaves_all_else_as_it_is(
    fleet: Fleet, operator: Operator
) -> None:
    """Request and limit would be the same then, of everything in the pod: another class of quality, which a pod can't change."""
    referred = deployment()
    resources = {"requests": {"cpu": "50m", "memory": "64Mi"}, "limits": {"cpu": "200m", "memory": "64Mi"}}
    referred["spec"]["template"]["spec"]["containers"][0]["resources"] = resources
    asked = degrading({"resize": {"cpu": "300m"}}, "Restart")
    fleet.create(referred, asked, workload(workloadRef={"kind": "Deployment", "name": "nav2"}))
    pod = in_control(fleet)
    say_degraded(fleet, True)
    said = fleet.wait_condition("RobotWorkload", "w", "Resized", "Refused")
    assert "qos" in said["message"].lower()
    assert cpu(fleet, pod) == ("50m", "200m")
    assert fleet.condition("RobotWorkload", "w", "Reconciled")["status"] == "True"


def test_a_pool_without_standbys_has_one_while_the_workload_is_degraded(fleet: Fleet, operator: Operator) -> None:
    asked = degrading({"prewarm": {"poolRef": {"name": "hot"}}}, "hot", "Restart")
    fleet.create(asked, hot(per_workload=0), workload())
    in_control(fleet)
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    assert len(fleet.instances()) == 1
    say_degraded(fleet, True)
    (standby,) = until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "a standby")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"
    fleet.make_ready(standby)
    until(lambda: fleet.get("RobotWorkload", "w")["status"]["standby"] == "Executing (1/1)", "it to count")
    say_degraded(fleet, False)
    until(lambda: not fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "it to go")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"


# -- strategies that are left to be chosen ------------------------------------------------------------------------------


def requiring(**requirements: str) -> Object:
    made = policy("Restart")
    made["spec"]["strategies"] = [{"type": "Auto"}]
    made["spec"]["requirements"] = requirements
    return made


def chosen(fleet: Fleet) -> list[str]:
    """The settings that the monitor gets: the pools of the strategies, and Restart."""
    settings = json.loads(fleet.get("ConfigMap", names.settings("w"), CORE)["data"]["settings.json"])
    return [one.get("poolRef", {}).get("name", one["type"]) for one in settings["strategies"]]


def test_what_is_required_decides_which_standbys_are_kept(fleet: Fleet, operator: Operator) -> None:
    fleet.create(requiring(taskCriticality="High"), hot(), spare(), workload())
    fleet.wait_built()
    until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "a standby")
    said = fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "Chosen", "True")
    assert said["message"].startswith(
        "Executing (hot), Uninitialized (spare), Restart. Required: a recovery within 500 ms"
    )
    assert chosen(fleet) == ["hot", "spare", "Restart"]
    assert fleet.get("FailurePolicy", "policy")["status"]["strategies"] == "Auto"
    fleet.cluster.patch(
        fleet.get("FailurePolicy", "policy"),
        {"spec": {"requirements": {"taskCriticality": "Low", "availability": "Low"}}},
    )
    until(lambda: not fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "the standby to go")
    until(lambda: chosen(fleet) == ["spare", "Restart"], "the monitor to be told")
    until(
        lambda: fleet.get("RobotWorkload", "w")["status"]["strategies"] == "Uninitialized (spare), Restart",
        "it to be said",
    )
    until(lambda: fleet.get("FallbackPool", "hot")["status"]["desired"] == 0, "the pool to want none")
    assert fleet.settled() == fleet.settled(), "and that is done once"
    fleet.cluster.patch(fleet.get("FailurePolicy", "policy"), {"spec": {"strategies": [{"type": "Restart"}]}})
    until(lambda: not fleet.condition("RobotWorkload", "w", "StrategiesChosen"), "nothing to be said of it any more")


def test_a_pool_that_comes_later_is_chosen_from(fleet: Fleet, operator: Operator) -> None:
    fleet.create(requiring(availability="High", resourceUsage="High"), workload())
    said = fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "RequirementsNotMet")
    assert "Not met: availability High requires 500 ms, but Restart" in said["message"]
    fleet.create(hot())
    fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "Chosen", "True")
    until(lambda: chosen(fleet) == ["hot", "Restart"], "the monitor to be told")


# -- situations ---------------------------------------------------------------------------------------------------------


def say_situation(fleet: Fleet, name: str) -> None:
    """What the monitor says; empty for none."""
    situation = {"situation": {"name": name, "since": "2026-01-01T00:00:00Z", "reason": "it is"}} if name else {}
    status = {"health": "Healthy", **situation}
    item = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": {"name": "w"}, "status": status}
    fleet.cluster.apply(item, fleet.namespace, subresource="status", manager="understudy-monitor")


def test_a_situation_raises_the_standby_and_lets_the_former_one_go_when_that_is_ready(
    fleet: Fleet, operator: Operator
) -> None:
    asked = policy("calm", "Restart")
    raised = policy("hot", "Restart")["spec"]["strategies"]
    asked["spec"]["situations"] = [{"name": "carrying", "when": {"task": {"action": "/go"}}, "strategies": raised}]
    fleet.create(asked, custom("FallbackPool", "calm", hot()["spec"]), hot(), workload())

    def standbys(pool: str) -> list[Object]:
        return fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}={pool}")

    fleet.wait_built()
    fleet.make_parts_ready()
    (own,) = until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.SOURCE}=workload"), "the workload's own pod")
    fleet.make_ready(own)
    fleet.commit(own)
    (calm,) = until(lambda: standbys("calm"), "a standby")
    fleet.make_ready(calm)
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "NoSituation", "True")
    assert chosen(fleet) == ["calm", "Restart"]
    assert standbys("hot") == []

    say_situation(fleet, "carrying")
    (standby,) = until(lambda: standbys("hot"), "another standby")
    said = fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "StandbyNotReady", "False")
    assert said["message"].endswith(
        "the strategies stay Executing (calm), Restart: no pod of FallbackPool hot is ready for it."
    )
    assert fleet.settled() == fleet.settled(), "nothing is written while it is waited for"
    assert chosen(fleet) == ["calm", "Restart"]
    assert [pod["metadata"]["name"] for pod in standbys("calm")] == [calm["metadata"]["name"]]
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"

    fleet.make_ready(standby)
    until(lambda: chosen(fleet) == ["hot", "Restart"], "the monitor to be told")
    until(lambda: not standbys("calm"), "the former one to go")
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "InForce", "True")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"
    until(lambda: fleet.get("FallbackPool", "calm")["status"]["desired"] == 0, "its pool to want none")
    assert fleet.settled() == fleet.settled(), "and that is done once"

    say_situation(fleet, "")
    (calm,) = until(lambda: standbys("calm"), "one as before")
    assert chosen(fleet) == ["hot", "Restart"]
    fleet.make_ready(calm)
    until(lambda: not standbys("hot"), "that of the situation to go")
    assert chosen(fleet) == ["calm", "Restart"]
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "NoSituation", "True")
