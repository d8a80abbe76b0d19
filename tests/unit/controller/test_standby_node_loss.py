"""Standbys of one robot on nodes that are emptied or were lost are replaced elsewhere first, and are spread over nodes."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.nodes import node, on
from tests.unit.controller.pools import condition, observe, plan
from tests.unit.controller.world import (
    IMAGES,
    World,
    created,
    deleted,
    gate,
    hot,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.pods import instance_pod, pod_placement
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.kube.client import NETWORK_POLICIES, NODES, PODS, POOLS, WORKLOADS, Object


class TestStandbys:
    def world(self, *standbys: Object) -> World:
        made = World(workload(), policy("hot", "Restart"), hot())
        active = on("n", source_pod("w-a"))
        made.own(gate(made.workload, active=active, epoch=3))
        made.pods = [active, *standbys]
        return made

    def planned(self, made: World, *leaves: str) -> Any:
        made.leaving = frozenset(leaves)
        return made.plan()

    def standby(self, made: World, place: str, name: str = "w-s", **more: Any) -> Object:
        return on(place, standby_pod(name, of=made.workload, template_hash=made.template_hash, **{"age": 50.0} | more))

    def replacement(self, made: World, place: str, name: str, **more: Any) -> Object:
        """A standby that was created to replace the pod of the workload's own controller."""
        return self.standby(made, place, name, annotations={names.REPLACES: "uid-w-own"}, **more)

    def test_standbys_on_leaving_nodes_are_replaced_first_and_the_active_instance_stays(self) -> None:
        empty = self.world()
        old, new = self.standby(empty, "m"), self.standby(empty, "o", "w-t")
        made = self.planned(self.world(old), "m", "n")
        assert (len(created(made, "pods")), deleted(made)) == (1, [])
        assert deleted(self.planned(self.world(old, new), "m", "n")) == ["w-s"]
        assert not created(self.planned(self.world(old)), "pods")

    def driven(self, per_workload: int) -> World:
        """A robot that a standby drives since the pod of its workload's own controller failed."""
        made = World(workload(), policy("hot", "Restart"), hot(per_workload=per_workload))
        made.build()
        made.build()
        made.pods = [self.standby(made, "n", "w-a")]
        made.own(gate(made.workload, active=made.pods[0], epoch=2))
        return made

    def now(self, made: World, *waiting: Object) -> tuple[int, list[str]]:
        """How many are made, and which go, where these wait beside the one that drives and node m is to be emptied."""
        made.pods = [made.pods[0], *waiting]
        plan = self.planned(made, "m")
        return len(created(plan, "pods")), deleted(plan)

    def own(self, made: World, place: str, name: str = "w-own", **more: Any) -> Object:
        return on(place, source_pod(name, template_hash=made.own_hash, **more))

    @pytest.mark.parametrize("ready", [True, False])
    @pytest.mark.parametrize("drives_on", ["n", "m"])
    def test_an_own_pod_on_a_leaving_node_is_replaced_before_it_is_deleted(self, drives_on: str, ready: bool) -> None:
        made = self.driven(per_workload=1)
        made.pods = [on(drives_on, made.pods[0])]
        own, other = self.own(made, "m", ready=ready), self.replacement(made, "o", "w-t")
        starting = self.replacement(made, "o", "w-t", ready=False)
        assert self.now(made, own) == (1, [])
        assert self.now(made, own, starting) == (0, [])
        assert self.now(made, own, other) == (0, ["w-own"])
        assert self.now(made, other) == (0, []), "the workload's own controller makes the next one"
        assert self.now(made, self.own(made, "o", "w-own2", ready=False), other) == (0, [])
        assert self.now(made, self.own(made, "o", "w-own2"), other) == (0, ["w-t"])

    def test_the_standby_that_replaces_an_own_pod_names_it(self) -> None:
        """Creation times would not show it: the API server records them in whole seconds."""
        made = self.driven(per_workload=1)
        made.pods = [made.pods[0], own := self.own(made, "m", age=50.0)]
        (new,) = created(self.planned(made, "m"), "pods")
        assert new["metadata"]["annotations"][names.REPLACES] == "uid-w-own"
        assert "requiredDuringSchedulingIgnoredDuringExecution" not in new["spec"]["affinity"]["podAntiAffinity"]
        assert self.now(made, own, self.replacement(made, "o", "w-t", age=50.0)) == (0, ["w-own"])

    def test_a_replacement_for_a_leaving_node_that_no_node_accepts_is_reported(self) -> None:
        made = self.driven(per_workload=1)
        stuck = self.replacement(made, "", "w-t", ready=False)
        stuck["status"]["conditions"] += [{"type": "PodScheduled", "status": "False", "reason": "Unschedulable"}]
        made.pods, made.leaving = [made.pods[0], self.own(made, "m"), stuck], frozenset({"m"})
        assert made.condition("Reconciled")["reason"] == "Unschedulable"

    async def test_the_pool_reports_an_own_pod_on_a_leaving_node_and_is_reconciled_for_it(self) -> None:
        made, store = self.driven(per_workload=1), Store()
        driving, own, pool = made.pods[0], self.own(made, "m"), made.others[1]
        objects = [(WORKLOADS, made.workload), (NETWORK_POLICIES, made.owned["networkpolicies", "w-gate"])]
        for resource, item in [
            *objects,
            (POOLS, pool),
            (PODS, driving),
            (PODS, own),
            (NODES, node("m")),
            (NODES, node("o")),
        ]:
            store.put(resource, item)
        reconciled: list[set[Key]] = []
        store.noticed = lambda sight: reconciled.append(change_index.of(sight, store).keys)
        store.put(NODES, node("m", version=6, unschedulable=True))
        assert reconciled == [{Key(POOLS.plural, "fleet", "hot"), Key(WORKLOADS.plural, "fleet", "w")}]
        client: Any = None
        observed = await Observer(client, store, Expectations()).pool(pool)
        assert_golden("operator", condition(observed, "Moving")["message"], "1 of 1")

    def test_an_own_pod_stays_until_replacements_on_other_nodes_are_ready_and_during_a_recovery(self) -> None:
        made = self.driven(per_workload=2)
        own, others = self.own(made, "m"), [self.standby(made, "o", "w-s"), self.replacement(made, "o", "w-t")]
        assert self.now(made, own, others[0]) == (1, []), "two others are needed before it goes"
        assert self.now(made, own, others[0], self.standby(made, "m", "w-t")) == (1, [])
        assert self.now(made, own, *others) == (0, ["w-own"])
        made.workload["status"] = {"health": "Recovering"}
        assert self.now(made, own, *others) == (0, [])

    def test_an_own_pod_that_is_scheduled_on_a_leaving_node_again_is_not_deleted(self) -> None:
        made = self.driven(per_workload=1)
        own, other = self.own(made, "m", "w-own2", age=10.0), self.replacement(made, "o", "w-t")
        assert self.now(made, own, other) == (0, [])
        assert deleted(self.planned(made)) == ["w-t"], "the node stays"

    def test_a_starting_own_pod_counts_as_replacement_for_a_standby_on_a_leaving_node(self) -> None:
        made = self.driven(per_workload=2)
        old, new = self.standby(made, "m", "w-s"), self.standby(made, "o", "w-t")
        starting = on("o", standby_pod("w-t", of=made.workload, template_hash=made.template_hash, ready=False))
        own = self.own(made, "p", ready=False)
        assert self.now(made, old, own) == (1, [])
        assert self.now(made, old, starting, own) == (0, [])
        assert self.now(made, old, new, own) == (0, []), "two are wanted, and so many are ready"
        assert self.now(made, old, new, self.own(made, "p")) == (0, ["w-s"])

    def test_an_additional_standby_on_a_leaving_node_stays_until_the_own_pod_is_ready(self) -> None:
        made = self.driven(per_workload=1)
        more = self.standby(made, "m")
        for own in ([], [self.own(made, "o", ready=False)]):
            assert self.now(made, more, *own) == (0, [])
        own = self.own(made, "o", ready=False)
        assert self.now(made, more, self.standby(made, "p", "w-t"), own) == (0, ["w-s"]), "the better one stays"
        assert self.now(made, more, self.own(made, "o")) == (0, ["w-s"])


class TestSpreading:
    def pod(self, **spec: Any) -> Object:
        pool = spare(replicas=1)
        pool["spec"]["template"]["spec"] |= spec
        (found,) = created(plan(observe(pool)), "pods")
        return found

    def test_pods_of_a_pool_prefer_nodes_without_others_of_the_pool(self) -> None:
        (term,) = self.pod()["spec"]["affinity"]["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
        assert term["weight"] == 100
        assert term["podAffinityTerm"]["topologyKey"] == "kubernetes.io/hostname"
        assert term["podAffinityTerm"]["labelSelector"]["matchLabels"] == {names.POOL: "spare"}

    def test_the_pods_of_a_pool_have_a_topology_spread_constraint(self) -> None:
        """For an affinity they are there, and a new pod would as soon be beside the one in control as where one has failed."""
        (constraint,) = self.pod()["spec"]["topologySpreadConstraints"]
        assert constraint == {
            "maxSkew": 1,
            "topologyKey": "kubernetes.io/hostname",
            "whenUnsatisfiable": "ScheduleAnyway",
            "labelSelector": {"matchLabels": {names.POOL: "spare"}},
        }

    @pytest.mark.parametrize(("when", "ours"), [("ScheduleAnyway", 0), ("DoNotSchedule", 1)])
    def test_a_spread_constraint_of_the_user_is_kept_and_its_duplicate_is_omitted(self, when: str, ours: int) -> None:
        constraint = {"maxSkew": 3, "topologyKey": "kubernetes.io/hostname", "whenUnsatisfiable": when}
        recipe = instance_pod.Recipe(workload="w", namespace="robots", images=IMAGES, secret="w-agent")
        template = {
            "spec": {
                "containers": [{"name": "app", "image": "app", "command": ["app"]}],
                "topologySpreadConstraints": [constraint],
            }
        }
        found = instance_pod.build(template, recipe)["spec"]["topologySpreadConstraints"]
        assert found[0] == constraint
        assert [one["labelSelector"]["matchLabels"] for one in found[1:]] == [{names.WORKLOAD: "w"}] * ours

    def test_placement_rules_of_the_template_replace_those_of_the_operator(self) -> None:
        spread = [{"maxSkew": 1, "topologyKey": "zone", "whenUnsatisfiable": "DoNotSchedule"}]
        found = self.pod(topologySpreadConstraints=spread)["spec"]
        assert found["topologySpreadConstraints"] == spread
        assert "affinity" not in found
        apart = {"podAntiAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": []}}
        assert self.pod(affinity=apart)["spec"]["affinity"] == apart
        near = {"nodeAffinity": {}}
        assert "podAntiAffinity" in self.pod(affinity=near)["spec"]["affinity"]

    def test_pods_leave_a_lost_node_soon(self) -> None:
        seconds = {t["tolerationSeconds"] for t in self.pod()["spec"]["tolerations"]}
        assert seconds == {pod_placement.LOST_SECONDS}
