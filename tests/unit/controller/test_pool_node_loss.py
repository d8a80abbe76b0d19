"""Waiting pods on nodes that are emptied or were lost are replaced elsewhere first, and never again and again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.nodes import held, leaving, node, on
from tests.unit.controller.pools import condition, observe, plan, present, status
from tests.unit.controller.world import (
    NOW,
    applied,
    created,
    deleted,
    held_pod,
    spare,
    stamp,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.observed import kube_objects, leaving_nodes
from understudy.controller.pods import pool_pods
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.runtime import resync
from understudy.kube.client import DISRUPTION_BUDGETS, NODES, PODS, POOLS, WORKLOADS, Object


class TestLeavingNodes:
    @pytest.mark.parametrize(
        ("found", "leaves"),
        [
            (node("n"), False),
            (node("n", taint="dedicated"), False),
            (node("n", unschedulable=True), True),
            (node("n", taint="node.kubernetes.io/unreachable"), True),
            (node("n", taint="node.kubernetes.io/not-ready"), True),
            (node("n", taint="ToBeDeletedByClusterAutoscaler"), True),
        ],
    )
    def test_cordoned_and_lost_nodes_are_leaving(self, found: Object, leaves: bool) -> None:
        assert leaving_nodes.is_leaving(found) is leaves

    def test_no_node_is_leaving_if_no_other_remains(self) -> None:
        lost = [node("n", taint="node.kubernetes.io/unreachable"), node("m", unschedulable=True)]
        assert leaving_nodes.leaving(lost) == frozenset()
        assert leaving_nodes.leaving([*lost, node("o")]) == {"n", "m"}

    def test_a_node_is_stored_without_other_fields(self) -> None:
        store = Store()
        assert resync.kept(NODES, node("n"))
        store.put(NODES, node("n", unschedulable=True, podCIDR="10.0.0.0/24"))
        found = store.get(NODES, "", "n")
        assert found is not None
        assert found["spec"] == {"unschedulable": True}
        assert found["metadata"] == {"name": "n", "uid": "uid-n", "resourceVersion": "5"}
        assert "status" not in found

    def test_only_a_change_of_schedulability_reconciles_the_owners_of_pods_on_the_node(self) -> None:
        store, reconciled, pool = Store(), [], spare()
        store.put(PODS, held(pool, "n")[0])
        store.put(PODS, on("n", standby_pod("w-s", of=workload())))
        store.put(PODS, on("other", standby_pod("x-s", of=workload("x"))))
        store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
        store.put(NODES, node("n"))
        store.put(NODES, node("n", version=6) | {"status": {}})
        store.put(NODES, node("n", version=7, unschedulable=True))
        store.put(NODES, node("n", version=8))
        mine = {
            Key(POOLS.plural, "fleet", "spare"),
            Key(POOLS.plural, "fleet", "hot"),
            Key(WORKLOADS.plural, "fleet", "w"),
        }
        assert reconciled == [set(), set(), mine, mine]

    def test_a_new_node_reconciles_pools_with_pods_that_could_not_move(self) -> None:
        store, reconciled = Store(), []
        store.put(PODS, held(spare(), "n")[0])
        store.put(NODES, node("n", unschedulable=True))
        store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
        store.put(NODES, node("m", version=9))
        assert reconciled == [{Key(POOLS.plural, "fleet", "spare")}]

    async def test_the_operator_observes_leaving_nodes(self) -> None:
        client: Any = None
        store, pool = Store(), spare()
        store.put(POOLS, pool)
        store.put(NODES, node("n", unschedulable=True))
        store.put(NODES, node("m"))
        found = await Observer(client, store, Expectations()).pool(pool)
        assert (found.leaving, found.cordoned) == ({"n"}, {"n"})
        store.put(NODES, node("m", version=9, unschedulable=True))
        found = await Observer(client, store, Expectations()).pool(pool)
        assert (found.leaving, found.cordoned) == (set(), {"n", "m"})


class TestSharedPool:
    def test_pods_on_a_leaving_node_are_replaced_before_they_are_deleted(self) -> None:
        pool = spare(replicas=2)
        pods = held(pool, "n", "m")
        made = plan(leaving(observe(pool, pods), "n"))
        assert (len(created(made, "pods")), deleted(made)) == (1, [])
        starting = held(pool, "m", ready=False, prefix="new")
        made = plan(leaving(observe(pool, pods + starting), "n"))
        assert (created(made, "pods"), deleted(made)) == ([], [])
        made = plan(leaving(observe(pool, pods + held(pool, "m", prefix="new")), "n"))
        assert (created(made, "pods"), deleted(made)) == ([], ["spare-0"])

    def test_pods_on_a_leaving_node_can_still_be_claimed(self) -> None:
        pool = spare(replicas=1)
        made = plan(leaving(observe(pool, held(pool, "n")), "n"))
        found = applied(made, "networkpolicies")["spare-held"]["metadata"]["annotations"][names.TEMPLATE_HASH]
        assert found == present(pool)

    def test_requested_pods_that_are_not_yet_observed_count_as_replacements(self) -> None:
        pool = spare(replicas=2)
        old = leaving(observe(pool, held(pool, "n", "n"), expected=2), "n")
        assert not created(plan(old), "pods")

    def test_replacements_on_the_same_leaving_node_never_exceed_twice_the_size(self) -> None:
        pool, moved = spare(replicas=2), 2
        for _ in range(5):
            made = plan(leaving(observe(pool, held(pool, *["n"] * moved)), "n"))
            moved += len(created(made, "pods"))
            assert not deleted(made)
        assert moved == 4

    def test_a_surplus_replacement_is_deleted_if_the_node_stays(self) -> None:
        pool = spare(replicas=1)
        pods = [*held(pool, "n"), *held(pool, "m", ready=False, prefix="new")]
        assert deleted(plan(observe(pool, pods))) == ["new-0"]

    def test_pods_are_replaced_once_if_node_and_template_change_together(self) -> None:
        pool = spare(replicas=2, updateStrategy={"minReady": 1})
        old = [on(place, held_pod(f"old-{place}", of=pool, template_hash="old")) for place in ("n", "m")]
        assert len(created(plan(leaving(observe(pool, old), "n")), "pods")) == 2

    def test_pods_on_a_leaving_node_are_replaced_with_the_on_replenish_strategy_too(self) -> None:
        pool = spare(replicas=1, updateStrategy={"type": "OnReplenish"})
        old = on("n", held_pod("old", of=pool, template_hash="old"))
        made = plan(leaving(observe(pool, [old]), "n"))
        assert (len(created(made, "pods")), deleted(made)) == (1, [])
        made = plan(leaving(observe(pool, [old, *held(pool, "m")]), "n"))
        assert deleted(made) == ["old"]

    def test_the_moving_condition_exists_only_while_pods_are_moved(self) -> None:
        pool = spare(replicas=2)
        observed = leaving(observe(pool, held(pool, "n", "m"), workloads=[workload()]), "n")
        moving = condition(observed, "Moving")
        assert (moving["status"], moving["reason"]) == ("True", "NodeLeaves")
        assert_golden("operator", moving["message"], "1 of 2", "(n)")
        assert "Moving" not in {c["type"] for c in status(observe(pool, held(pool, "n", "m")))["conditions"]}


class TestEvictions:
    """Of waiting pods: whether the API server refuses them for now."""

    def budget(self, observed: pool_pods.Observed) -> Object | None:
        return applied(plan(observed), "poddisruptionbudgets").get("spare-held")

    def moving(self, pool: Object, *, since: float) -> Object:
        condition = {"type": "Moving", "status": "True", "reason": "NodeLeaves", "lastTransitionTime": stamp(since)}
        return pool | {"status": {"conditions": [condition]}}

    def test_the_budget_protects_all_pods_until_replacements_are_ready(self) -> None:
        pool = spare(replicas=2)
        for observed in (observe(pool), leaving(observe(pool, held(pool, "n", "m")), "n")):
            found = self.budget(observed)
            assert found is not None
            assert found["spec"]["minAvailable"] == 2
            assert found["spec"]["unhealthyPodEvictionPolicy"] == "AlwaysAllow"
            assert found["spec"]["selector"] == {
                "matchLabels": {names.POOL: "spare", names.HELD: "true", names.CLAIMED_BY: names.UNCLAIMED}
            }

    def test_an_empty_pool_has_no_budget(self) -> None:
        assert self.budget(observe(spare(replicas=0))) is None

    def test_a_pool_has_no_budget_if_a_budget_of_the_user_selects_its_pods(self) -> None:
        pool = spare(replicas=1)
        others = [{"spec": {"selector": {"matchLabels": {"app": "nav"}}}}]
        assert self.budget(replace(observe(pool), budgets=others)) is None
        unrelated = [{"spec": {"selector": {"matchLabels": {"app": "other"}}}}, {"spec": {}}]
        assert self.budget(replace(observe(pool), budgets=unrelated)) is not None

    def release(self, observed: pool_pods.Observed) -> bool:
        live = {("poddisruptionbudgets", "spare-held"): {"metadata": {"name": "spare-held"}}}
        return "spare-held" in deleted(plan(replace(observed, owned=live)))

    def test_the_budget_is_removed_if_a_replacement_cannot_start(self) -> None:
        pool = spare(replicas=1)
        coming = held_pod("new", of=pool, template_hash=present(pool), ready=False, waiting="ErrImageNeverPull")
        assert self.release(leaving(observe(pool, [*held(pool, "n"), coming]), "n"))
        assert not self.release(observe(pool, [*held(pool, "n"), coming])), "nothing is moved"

    def test_the_budget_is_removed_after_two_minutes(self) -> None:
        pool = spare(replicas=1)
        late = self.moving(pool, since=NOW - 119)
        observed = leaving(observe(late, held(pool, "n"), expected=1), "n")
        assert not self.release(observed)
        assert plan(observed).again_after == pytest.approx(1)
        assert self.release(leaving(observe(self.moving(pool, since=NOW - 120), held(pool, "n")), "n"))

    def test_the_budget_is_removed_if_every_node_is_drained_because_no_replacement_would_come(self) -> None:
        pool = spare(replicas=2)
        pods = held(pool, "n", "m")
        assert not self.release(replace(observe(pool, pods), cordoned=frozenset({"o"})))
        drained = replace(observe(pool, pods), cordoned=frozenset({"n"}))
        assert self.release(drained)
        (moving,) = (c for c in status(drained)["conditions"] if c["type"] == "Moving")
        assert (moving["status"], moving["reason"]) == ("False", "NoOtherNode")
        refused = spare(replicas=2)
        del refused["spec"]["template"]["spec"]["containers"][0]["command"]
        assert self.release(replace(observe(refused, pods), cordoned=frozenset({"n"})))

    def test_the_budget_is_removed_if_the_pool_creates_no_pods(self) -> None:
        pool = spare(replicas=1)
        pods = held(pool, "n")
        del pool["spec"]["template"]["spec"]["containers"][0]["command"]
        assert self.release(leaving(observe(pool, pods), "n"))
        assert not self.release(observe(pool, pods))

    async def test_the_operator_observes_budgets_of_others(self) -> None:
        client: Any = None
        store, pool = Store(), spare()
        store.put(POOLS, pool)
        metadata = {"name": "theirs", "namespace": "fleet", "uid": "u", "resourceVersion": "3"}
        store.put(DISRUPTION_BUDGETS, {"metadata": metadata, "spec": {}})
        ours = {**metadata, "name": "ours", "uid": "v", "ownerReferences": [kube_objects.owner("FallbackPool", pool)]}
        store.put(DISRUPTION_BUDGETS, {"metadata": ours, "spec": {}})
        (found,) = (await Observer(client, store, Expectations()).pool(pool)).budgets
        assert found["metadata"]["name"] == "theirs"
