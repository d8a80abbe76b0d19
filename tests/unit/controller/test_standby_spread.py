"""If nodes allow it, one standby is not on the node of the active instance, also after a failover."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller.nodes import node, on
from tests.unit.controller.world import (
    NOW,
    World,
    created,
    deleted,
    gate,
    hot,
    patched,
    pod,
    policy,
    source_pod,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.desired import standby_spread
from understudy.controller.observed import kube_objects
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import Store
from understudy.kube.client import NODES, PODS, WORKLOADS, Object

TAINT = {"key": "robots", "value": "yes", "effect": "NoSchedule"}


def world(per_workload: int = 1, *, nodes: tuple[Object, ...] = (), **spec: Any) -> World:
    """A robot whose own pod is active on node a."""
    made = World(workload(**spec), policy("hot", "Restart"), hot(per_workload=per_workload))
    made.nodes = list(nodes or (node("a"), node("b")))
    active = on("a", source_pod("w-active"))
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=2))
    return made


def standby(made: World, place: str, name: str = "w-s", **more: Any) -> Object:
    return on(place, standby_pod(name, of=made.workload, template_hash=made.template_hash, **more))


def now(made: World, *waiting: Object) -> tuple[list[Object], list[str]]:
    """Which pods are created, and which are deleted, with these standbys beside the active pod."""
    made.pods = [made.pods[0], *waiting]
    plan = made.plan()
    return created(plan, "pods"), deleted(plan)


def apart(pod: Object) -> list[str]:
    """The instances beside which the scheduler must not place a pod."""
    key = "requiredDuringSchedulingIgnoredDuringExecution"
    terms = pod["spec"]["affinity"]["podAntiAffinity"].get(key, [])
    return [term["labelSelector"]["matchLabels"][names.INSTANCE] for term in terms]


class TestPoolStandbys:
    def test_the_only_standby_on_the_node_of_the_active_instance_is_first_replaced_on_another_node(self) -> None:
        made = world()
        old = standby(made, "a")
        (new,), gone = now(made, old)
        assert (apart(new), gone) == (["w-active"], [])
        starting = standby(made, "b", "w-t", ready=False, age=5.0)
        assert now(made, old, starting) == ([], [])
        assert now(made, old, standby(made, "b", "w-t", age=5.0)) == ([], ["w-s"])
        assert now(made, standby(made, "b", "w-t", age=5.0)) == ([], [])

    def test_one_standby_elsewhere_is_enough(self) -> None:
        made = world(per_workload=2)
        first, second, third = (standby(made, "a", f"w-{letter}", age=50.0) for letter in "stu")
        assert now(made, first, standby(made, "b", "w-t")) == ([], [])
        assert now(made, first, standby(made, "b", "w-t", ready=False)) == ([], []), "it starts"
        ((new,), gone) = now(made, first, second)
        assert (apart(new), gone) == (["w-active"], [])
        assert len(now(made, first, second, standby(made, "b", "w-n", ready=False))[1]) == 0
        assert len(now(made, first, second, standby(made, "b", "w-n"))[1]) == 1
        assert now(made, second, standby(made, "b", "w-n")) == ([], [])
        (ordinary,), _ = now(made, third)
        assert apart(ordinary) == [], "a missing standby is placed by preference first"

    def test_a_smaller_pool_keeps_the_standby_on_another_node(self) -> None:
        made = world(per_workload=1)
        assert now(made, standby(made, "a", "w-s", age=900.0), standby(made, "b", "w-t", age=5.0)) == ([], ["w-s"])

    @pytest.mark.parametrize(
        "nodes",
        [
            (node("a"),),
            (node("a"), node("b", unschedulable=True)),
            (node("a"), node("b", taint="node.kubernetes.io/unreachable")),
            (node("a"), node("b", taints=[TAINT])),
        ],
    )
    def test_nothing_moves_without_another_node_that_accepts_the_pod(self, nodes: tuple[Object, ...]) -> None:
        made = world(nodes=nodes)
        assert now(made, standby(made, "a")) == ([], [])

    def test_a_node_whose_taint_the_template_tolerates_accepts_the_pod(self) -> None:
        made = world(nodes=(node("a"), node("b", taints=[TAINT])))
        made.workload["spec"]["template"]["spec"]["tolerations"] = [{"key": "robots", "operator": "Exists"}]
        assert len(now(made, standby(made, "a"))[0]) == 1

    @pytest.mark.parametrize(
        "placement",
        [
            {
                "topologySpreadConstraints": [
                    {"maxSkew": 1, "topologyKey": "zone", "whenUnsatisfiable": "DoNotSchedule"}
                ]
            },
            {"affinity": {"podAntiAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": []}}},
        ],
    )
    def test_a_template_with_placement_rules_of_its_own_is_left_alone(self, placement: Object) -> None:
        made = world()
        made.workload["spec"]["template"]["spec"] |= placement
        assert now(made, standby(made, "a")) == ([], [])

    def test_nothing_moves_during_a_recovery_or_a_switchover(self) -> None:
        made = world()
        old, new = standby(made, "a"), standby(made, "b", "w-t")
        for status in ({"health": "Recovering"}, {"switchover": {"phase": "Preparing"}}):
            made.workload["status"] = status
            assert now(made, old) == ([], [])
            assert now(made, old, new) == ([], [])

    def test_nothing_moves_while_a_new_template_is_rolled_out(self) -> None:
        made = world()
        old = on("a", standby_pod("w-s", of=made.workload, template_hash="old"))
        (new,), gone = now(made, old)
        assert (apart(new), gone) == ([], [])

    @pytest.mark.parametrize(("age", "reason"), [(31.0, "Unschedulable"), (121.0, "")])
    def test_a_replacement_that_cannot_start_is_given_up_for_some_time(self, age: float, reason: str) -> None:
        made = world()
        old = standby(made, "a")
        notes = {names.REPLACES: "uid-w-s"}
        stuck = standby(made, "", "w-t", ready=False, age=age, annotations=notes)
        if reason:
            stuck["status"]["conditions"] += [{"type": "PodScheduled", "status": "False", "reason": reason}]
        made.pods = [made.pods[0], old, stuck]
        assert made.condition("Reconciled")["status"] == "True", "the present standby stays"
        plan = made.plan()
        mark = patched(plan, "pods")["w-s"]["metadata"]["annotations"]
        assert deleted(plan) == ["w-t"]
        marked = standby(made, "a", annotations=mark)
        assert now(made, marked) == ([], [])
        made.now = NOW + standby_spread.REST_SECONDS + 1.0
        assert len(now(made, marked)[0]) == 1

    def test_a_replacement_that_no_node_accepts_does_not_count_after_the_replaced_standby_is_gone(self) -> None:
        made = world()
        stuck = standby(made, "", "w-t", ready=False, age=200.0, annotations={names.REPLACES: "uid-w-s"})
        assert now(made, standby(made, "a"), stuck)[0] == []
        (new,), gone = now(made, stuck)
        assert (apart(new), gone) == ([], []), "it may be beside the active instance"
        third = {"name": "w-u", "annotations": {names.REPLACES: "uid-w-t"}}
        assert now(made, stuck, standby(made, "a", ready=False, **third)) == ([], [])
        assert now(made, stuck, standby(made, "a", **third)) == ([], ["w-t"])


class TestOwnPod:
    """The pod of the workload's own controller waits in place of the standby that is active."""

    def driven(self) -> World:
        made = World(workload(), policy("hot", "Restart"), hot())
        made.build()
        made.build()
        made.nodes = [node("a"), node("b")]
        made.pods = [standby(made, "a", "w-active")]
        made.own(gate(made.workload, active=made.pods[0], epoch=2))
        return made

    def own(self, made: World, place: str, name: str = "w-own", **more: Any) -> Object:
        return on(place, source_pod(name, template_hash=made.own_hash, **more))

    def test_it_is_replaced_once_and_the_other_standby_stays_until_it_is_elsewhere(self) -> None:
        made = self.driven()
        own = self.own(made, "a", age=20.0)
        other = standby(made, "b", "w-t", age=20.0, annotations={names.REPLACES: "uid-w-own"})
        (new,), gone = now(made, own)
        assert (apart(new), gone) == (["w-active"], [])
        assert new["metadata"]["annotations"][names.REPLACES] == "uid-w-own"
        assert now(made, own, standby(made, "b", "w-t", ready=False, age=20.0)) == ([], [])
        assert now(made, own, other) == ([], ["w-own"])
        again = self.own(made, "a", "w-own2", age=20.0)
        assert now(made, again, other) == ([], []), "the scheduler placed it there again"
        assert now(made, self.own(made, "b", "w-own2", ready=False, age=5.0), other) == ([], [])
        assert now(made, self.own(made, "b", "w-own2", age=5.0), other) == ([], ["w-t"])

    def test_a_standby_that_was_to_replace_the_pod_that_took_over_replaces_it(self) -> None:
        made = self.driven()
        own = self.own(made, "a", age=20.0)
        other = standby(made, "b", "w-t", age=20.0, annotations={names.REPLACES: "uid-w-active"})
        assert now(made, own, other) == ([], [])
        mark = patched(made.plan(), "pods")["w-t"]["metadata"]["annotations"]
        assert mark == {names.REPLACES: "uid-w-own"}
        assert now(made, own, standby(made, "b", "w-t", age=20.0, annotations=mark)) == ([], ["w-own"])

    def test_it_stays_on_another_node(self) -> None:
        made = self.driven()
        assert now(made, self.own(made, "b")) == ([], [])


@pytest.mark.parametrize("beside", ["instance", "monitor"])
def test_a_node_that_returns_reconciles_the_robots_with_several_pods_on_one_node(beside: str) -> None:
    made, store = world(), Store()
    other = standby(made, "a") if beside == "instance" else on("a", pod("w-m", labels={names.MONITORED: "w"}))
    crowded = [on("a", source_pod("w-a")), other]
    spread = [on("a", source_pod("v-a", of="v")), on("b", source_pod("v-b", of="v"))]
    for item in (*crowded, *spread):
        store.put(PODS, item)
    store.put(WORKLOADS, made.workload)
    for item in (node("a"), node("b"), node("c", taint="node.kubernetes.io/unreachable")):
        store.put(NODES, item)
    reconciled: list[set[Key]] = []
    store.noticed = lambda change: reconciled.append(set(change_index.of(change, store).keys))
    store.put(NODES, node("c", version=6))
    assert reconciled == [{Key(WORKLOADS.plural, "fleet", kube_objects.name(made.workload))}]
