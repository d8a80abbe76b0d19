"""Nodes that are drained: whose evictions wait, for how long, and what the monitor gets."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import (
    NAMESPACE,
    NOW,
    World,
    applied,
    claimed_pod,
    deleted,
    gate,
    hot,
    patched,
    pod,
    policy,
    source_pod,
    spare,
    workload,
)
from understudy.api import names
from understudy.api.kinds.switchover_spec import Drain, request
from understudy.controller.observed import kube_objects, leaving_nodes
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import Store
from understudy.controller.status import workload_status
from understudy.kube.client import DISRUPTION_BUDGETS, NODES, PODS, WORKLOADS, Object

BUDGETS = "poddisruptionbudgets"


def on(node: str, item: Object) -> Object:
    return {**item, "spec": {"nodeName": node}}


def world(*strategies: str, **spec: Any) -> World:
    """A workload of which w-1, on node-1, is in control."""
    item = workload(**spec)
    active = on("node-1", source_pod("w-1"))
    made = World(item, policy(*strategies or ("hot", "Restart")), hot(), spare(), pods=[active])
    made.own(gate(item, active=active, epoch=1))
    return made


def written_drain(made: World) -> Drain | None:
    """The drain that the monitor gets."""
    text = applied(made.plan(), "configmaps")["w-settings"]["data"]["settings.json"]
    found = json.loads(text).get("drain")
    return Drain.model_validate(found) if found else None


def condition(made: World) -> Object | None:
    return next((c for c in made.status()["conditions"] if c["type"] == "Draining"), None)


def budget(name: str, **labels: str) -> Object:
    return {
        "apiVersion": "policy/v1",
        "kind": "PodDisruptionBudget",
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "uid": f"uid-{name}",
            "generation": 1,
            "resourceVersion": "5",
        },
        "spec": {"maxUnavailable": 1, "selector": {"matchLabels": labels}},
    }


def test_the_disruption_budget_covers_only_the_active_instance() -> None:
    made = world()
    (found,) = applied(made.plan(), BUDGETS).values()
    assert kube_objects.name(found) == "w-in-control"
    assert found["spec"] == {
        "minAvailable": 1,
        "unhealthyPodEvictionPolicy": "AlwaysAllow",
        "selector": {"matchLabels": {names.INSTANCE: "w-1"}},
    }
    assert (written_drain(made), condition(made)) == (None, None), "no node is drained"


def test_the_disruption_budget_follows_the_active_instance() -> None:
    made = world()
    made.build()
    standby = on("node-2", claimed_pod("s-1", of=spare(), by=made.workload))
    made.pods.append(standby)
    made.own(gate(made.workload, active=standby, epoch=2))
    assert applied(made.plan(), BUDGETS)["w-in-control"]["spec"]["selector"]["matchLabels"][names.INSTANCE] == "s-1"


def test_the_disruption_budget_does_not_change_during_a_recovery() -> None:
    made = world()
    made.build()
    made.own(gate(made.workload, epoch=2))
    plan = made.plan()
    assert (applied(plan, BUDGETS), deleted(plan)) == ({}, [])


def test_the_monitor_receives_the_drained_node_and_all_cordoned_nodes() -> None:
    made = world()
    made.cordoned = frozenset({"node-1", "node-3"})
    assert written_drain(made) == Drain(uid="uid-w-1", node="node-1", since=NOW, cordoned=["node-1", "node-3"])
    found = condition(made)
    assert found is not None
    assert (found["status"], found["reason"]) == ("True", "Held")
    assert_golden("operator", found["message"], "node-1", "w-1", "22:18:20")


def test_a_drain_of_another_node_has_no_effect() -> None:
    made = world()
    made.cordoned = frozenset({"node-2"})
    assert (written_drain(made), condition(made)) == (None, None)


def test_evictions_are_held_for_a_limited_time() -> None:
    made = world()
    made.cordoned = frozenset({"node-1"})
    plan = made.build()
    assert plan.again_after == 300.0, "5m, as it is by default"
    made.now = NOW + 200
    assert (written_drain(made) or Drain(uid="", node="", since=0, cordoned=[])).since == NOW, (
        "an operator that is new knows it too"
    )
    assert made.plan().again_after == 100.0
    made.now = NOW + 301
    assert deleted(made.plan()) == ["w-in-control"]
    found = condition(made)
    assert found is not None
    assert (found["status"], found["reason"]) == ("False", "HoldEnded")
    assert "no instance on another node took over within 5m" in found["message"]
    assert written_drain(made) is not None, "the monitor goes on trying until the pod goes"


def test_the_policy_sets_how_long_evictions_are_held() -> None:
    made = world(draining={"holdFor": "20s"})
    made.cordoned = frozenset({"node-1"})
    assert made.build().again_after == 20.0
    made = world(draining={"holdFor": "0s"})
    made.cordoned = frozenset({"node-1"})
    assert applied(made.plan(), BUDGETS) == {}
    assert (condition(made) or {})["reason"] == "NotAskedFor"


def test_evictions_are_not_held_if_no_instance_could_take_over() -> None:
    made = world("Restart")
    assert applied(made.plan(), BUDGETS) == {}
    made.cordoned = frozenset({"node-1"})
    found = condition(made)
    assert found is not None
    assert (found["status"], found["reason"]) == ("False", "NoFallback")
    assert written_drain(made) is not None


def test_a_disruption_budget_of_the_user_replaces_that_of_the_operator() -> None:
    made = world()
    made.build()
    made.budgets = [budget("others", app="another")]
    assert "w-in-control" in applied(made.plan(), BUDGETS)
    made.budgets = [budget("theirs", **{names.COMPONENT: "instance"})]
    assert deleted(made.plan()) == ["w-in-control"], "with two of them Kubernetes refuses every eviction, for good"
    made.cordoned = frozenset({"node-1"})
    assert_golden("operator", (condition(made) or {})["message"], "PodDisruptionBudget theirs")


def test_evictions_are_not_held_while_the_spec_is_refused_because_the_monitor_is_not_informed_of_the_drain() -> None:
    made = world()
    made.build()
    made.workload["spec"]["template"]["spec"]["hostNetwork"] = True
    assert deleted(made.plan()) == [], "no node is drained"
    made.cordoned = frozenset({"node-1"})
    assert deleted(made.plan()) == ["w-in-control"]
    found = condition(made)
    assert found is not None
    assert (found["status"], found["reason"]) == ("False", "NotAccepted")


def test_evictions_are_not_held_while_the_address_of_the_discovery_server_is_unknown() -> None:
    made = world()
    made.build()
    del made.owned["services", names.discovery("w")]
    made.cordoned = frozenset({"node-1"})
    assert "w-in-control" in deleted(made.plan())


@pytest.mark.parametrize("health", ["Recovering", "Failed"])
def test_evictions_of_a_fenced_instance_that_stays_are_not_held(health: str) -> None:
    made = world()
    made.build()
    made.own(gate(made.workload, epoch=2))
    made.workload["status"] = {"health": health}
    made.cordoned = frozenset({"node-2"})
    assert deleted(made.plan()) == []
    made.cordoned = frozenset({"node-1"})
    assert deleted(made.plan()) == ["w-in-control"]


def test_a_drain_causes_an_event() -> None:
    made = world()
    made.cordoned = frozenset({"node-1"})
    made.workload["status"] = {"conditions": []}
    found = [c for c in workload_status.transitions(made.workload, made.status()) if c["type"] == "Draining"]
    assert [c["reason"] for c in found] == ["Held"]


@pytest.mark.parametrize(
    ("spec", "is_cordoned"),
    [
        ({}, False),
        ({"unschedulable": True}, True),
        ({"taints": [{"key": "node.kubernetes.io/not-ready", "effect": "NoExecute"}]}, False),
        ({"taints": [{"key": "ToBeDeletedByClusterAutoscaler", "effect": "NoSchedule"}]}, True),
        ({"taints": [{"key": "karpenter.sh/disrupted", "effect": "NoSchedule"}]}, True),
    ],
)
def test_an_unschedulable_node_and_one_with_a_removal_taint_are_cordoned(spec: Object, is_cordoned: bool) -> None:
    assert leaving_nodes.is_cordoned({"spec": spec}) == is_cordoned


def node(version: int, **spec: Any) -> Object:
    metadata = {"name": "node-1", "uid": "uid-node-1", "resourceVersion": str(version), "labels": {"a": "b"}}
    return {"apiVersion": "v1", "kind": "Node", "metadata": metadata, "spec": spec, "status": {"images": ["many"]}}


def test_a_node_is_stored_without_other_fields_and_only_a_cordon_reconciles_workloads() -> None:
    store, reconciled = Store(), []
    store.put(WORKLOADS, workload())
    store.put(PODS, on("node-1", source_pod("w-1")))
    store.put(PODS, on("node-2", source_pod("v-1", of="v")))
    store.put(PODS, on("node-1", pod("stranger")))
    store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
    store.put(NODES, node(1, podCIDR="10.0.0.0/24"))
    store.put(NODES, node(2))
    store.put(NODES, node(3, unschedulable=True))
    store.put(NODES, node(4, unschedulable=True))
    store.put(NODES, node(5))
    affected_ones = {Key(WORKLOADS.plural, NAMESPACE, "w")}
    assert reconciled == [set(), set(), affected_ones, set(), affected_ones]
    found = store.get(NODES, "", "node-1")
    assert found is not None
    assert "status" not in found
    assert "labels" not in found["metadata"]


def test_a_new_budget_of_the_user_reconciles_every_workload_of_its_namespace() -> None:
    store, reconciled = Store(), []
    store.put(WORKLOADS, workload())
    store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
    theirs = budget("theirs")
    store.put(DISRUPTION_BUDGETS, theirs)
    theirs = {**theirs, "metadata": {**theirs["metadata"], "resourceVersion": "6"}, "status": {"currentHealthy": 1}}
    store.put(DISRUPTION_BUDGETS, theirs)
    assert reconciled == [{Key(WORKLOADS.plural, NAMESPACE, "w")}, set()], "what its controller counts means nothing"


def test_a_pod_that_starts_for_a_planned_switchover_is_not_scaled_down() -> None:
    made = world("spare", "Restart")
    made.others = [item for item in made.others if kube_objects.name(item) != "hot"]
    driving = on("node-2", claimed_pod("s-1", of=spare(), by=made.workload))
    made.build()
    made.pods = [driving]
    made.own(gate(made.workload, active=driving, epoch=2))
    assert patched(made.plan(), "replicasets")["w"] == {"spec": {"replicas": 0}}
    asked = request("failback", NOW)
    made.workload["metadata"]["annotations"] = {names.SWITCHOVER: asked}
    assert "w" not in patched(made.plan(), "replicasets")
    made.workload["status"] = {"switchover": {"handled": asked, "phase": "Waiting"}}
    assert "w" not in patched(made.plan(), "replicasets"), "such as for a drain, for which nobody asks"
    made.workload["status"] = {"switchover": {"handled": asked, "phase": "NotDone"}}
    assert patched(made.plan(), "replicasets")["w"] == {"spec": {"replicas": 0}}, "it came to nothing"


def test_a_clock_that_is_set_back_does_not_prolong_the_hold_of_evictions() -> None:
    # What was begun is then of tomorrow, and would end a day later than it should.
    made = world(draining={"holdFor": "60s"})
    made.cordoned = frozenset({"node-1"})
    made.now = NOW + 86400
    made.build()
    made.now = NOW
    made.build()
    assert (written_drain(made) or Drain(uid="", node="", since=0, cordoned=[])).since == NOW
    made.now = NOW + 61
    assert (condition(made) or {})["reason"] == "HoldEnded"
