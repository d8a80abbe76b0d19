"""Strategies that change with the robot's situation: what is kept and in force before, while and after, without a moment without."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.controller.strategy_policies import auto, order, pools_of, settings_of, warm
from tests.unit.controller.world import (
    World,
    created,
    deleted,
    gate,
    held_pod,
    hot,
    patched,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.controller.observed import kube_objects, policy_reader
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.status import policy_status
from understudy.kube.client import POLICIES, POOLS, WORKLOADS, Object

WHEN: Object = {"task": {"action": "/carry"}}


def fallbacks(*strategies: str) -> list[Object]:
    found: list[Object] = policy(*strategies)["spec"]["strategies"]
    return found


def situational(*situations: tuple[str, tuple[str, ...]], always: tuple[str, ...] = ("warm", "spare")) -> Object:
    """A policy with situations, each with its strategies."""
    made = policy(*always, "Restart")
    made["spec"]["situations"] = [
        {"name": name, "when": WHEN, "strategies": fallbacks(*strategies, "Restart")} for name, strategies in situations
    ]
    return made


CARRYING = situational(("carrying", ("hot", "spare")))


def status_in(situation: str, **more: Any) -> Object:
    status = {"situation": {"name": situation, "since": "2026-01-01T00:00:00Z"}} if situation else {}
    return {"health": "Healthy", **status, **more}


def world(asked: Object = CARRYING) -> World:
    """A workload with its pod in control and a standby of the pool that is always in force, all of it built."""
    made = World(workload(status=status_in("")), asked, hot(), warm(), spare())
    active = source_pod("w-a")
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=3))
    made.unclaimed = {"spare": [held_pod("s-1", of=spare())]}
    made.build()
    made.pods.append(standby(made, "w-warm", "warm"))
    return made


def standby(made: World, name: str, pool: str, *, ready: bool = True) -> Object:
    builts = made.understood().builts
    return standby_pod(
        name,
        of=made.workload,
        pool=pool,
        ready=ready,
        template_hash=builts[pool]["metadata"]["labels"]["understudy.dev/template-hash"],
    )


def enter(made: World, situation: str) -> None:
    """What the monitor says."""
    made.workload["status"] = status_in(situation)


def covered(made: World) -> tuple[str, str]:
    found = made.condition("SituationCovered")
    return found["status"], found["reason"]


def test_without_a_situation_the_strategies_of_the_policy_are_in_force() -> None:
    made = world()
    plan = made.plan()
    assert order(plan) == ["warm", "spare", "Restart"]
    assert settings_of(plan).situation is None
    assert pools_of(plan) == set()
    assert covered(made) == ("True", "NoSituation")


def test_a_situation_changes_only_its_standby_until_that_is_ready() -> None:
    made = world()
    enter(made, "carrying")
    plan = made.plan()
    assert pools_of(plan) == {"hot"}
    assert deleted(plan) == []
    assert order(plan) == ["warm", "spare", "Restart"], "what is there would be used, as ever"
    assert [choice.name for choice in settings_of(plan).pools] == ["warm", "spare", "hot"], "the monitor brings it up"
    assert covered(made) == ("False", "StandbyNotReady")
    assert_golden(
        "operator",
        made.condition("SituationCovered")["message"],
        "carrying",
        "Initialized (warm), Uninitialized (spare), Restart",
        "FallbackPool hot",
    )
    assert made.condition("Protected")["status"] == "True"
    assert made.status()["standby"] == "Initialized (1/1)"


def test_the_former_standby_is_deleted_after_the_monitor_has_the_new_strategies() -> None:
    made = world()
    enter(made, "carrying")
    made.build()
    made.pods.append(standby(made, "w-hot", "hot"))
    plan = made.plan()
    assert order(plan) == ["hot", "spare", "Restart"]
    assert settings_of(plan).situation == "carrying"
    assert deleted(plan) == [], "the monitor isn't told yet"
    made.build()
    assert deleted(made.plan()) == ["w-warm"]
    assert covered(made) == ("True", "InForce")
    assert made.condition("Protected")["status"] == "True"
    assert made.status()["standby"] == "Executing (1/1)"


def test_the_end_of_a_situation_restores_the_former_standby_before_the_other_is_deleted() -> None:
    made = world()
    enter(made, "carrying")
    made.pods = [made.pods[0], standby(made, "w-hot", "hot")]
    made.build()
    assert settings_of(made.plan()).situation == "carrying"
    enter(made, "")
    plan = made.build()
    assert pools_of(plan) == {"warm"}
    assert deleted(plan) == []
    assert order(plan) == ["hot", "spare", "Restart"]
    assert_golden("operator", made.condition("SituationCovered")["message"], "carrying", "Executing (hot)")
    made.pods.append(standby(made, "w-warm", "warm"))
    made.build()
    assert deleted(made.plan()) == ["w-hot"]
    assert order(made.plan()) == ["warm", "spare", "Restart"]


def test_a_situation_that_ends_before_its_standby_is_ready_leaves_nothing_behind() -> None:
    made = world()
    enter(made, "carrying")
    made.build()
    made.pods.append(standby(made, "w-hot", "hot", ready=False))
    enter(made, "")
    assert deleted(made.plan()) == ["w-hot"]
    assert covered(made) == ("True", "NoSituation")


def test_a_standby_that_never_becomes_ready_does_not_remove_protection() -> None:
    made = world()
    enter(made, "carrying")
    made.build()
    made.pods.append(standby(made, "w-hot", "hot", ready=False))
    for _ in range(3):
        plan = made.build()
        assert deleted(plan) == []
        assert order(plan) == ["warm", "spare", "Restart"]
        assert made.condition("Protected")["status"] == "True"


def test_one_situation_can_follow_another_directly() -> None:
    made = world(situational(("carrying", ("hot",)), ("parked", ("spare",))))
    enter(made, "carrying")
    made.pods.append(standby(made, "w-hot", "hot"))
    made.build()
    enter(made, "parked")
    plan = made.build()
    assert order(plan) == ["spare", "Restart"], "one of a shared pool is there"
    assert deleted(made.plan()) == ["w-hot", "w-warm"]


def test_strategies_with_a_dry_shared_pool_do_not_come_into_force() -> None:
    made = world(situational(("parked", ("spare",))))
    made.unclaimed = {}
    enter(made, "parked")
    assert order(made.plan()) == ["warm", "spare", "Restart"]


@pytest.mark.parametrize("strategies", [("gone", "hot"), ("empty", "hot")])
def test_a_missing_or_empty_pool_does_not_delay_the_strategies_of_a_situation(strategies: tuple[str, ...]) -> None:
    made = world(situational(("carrying", strategies)))
    made.others.append(hot("empty", per_workload=0))
    enter(made, "carrying")
    made.build()
    made.pods.append(standby(made, "w-hot", "hot"))
    assert order(made.plan()) == [*strategies, "Restart"]


def test_a_situation_with_only_a_restart_is_in_force_at_once() -> None:
    made = world(situational(("parked", ())))
    enter(made, "parked")
    made.build()
    assert order(made.plan()) == ["Restart"]
    assert "w-warm" in deleted(made.plan())


def test_a_recovery_delays_the_strategies_of_a_situation() -> None:
    made = world()
    made.pods.append(standby(made, "w-hot", "hot"))
    made.workload["status"] = status_in("carrying", health="Recovering")
    plan = made.plan()
    assert order(plan) == ["warm", "spare", "Restart"]
    assert settings_of(plan).situation is None
    assert deleted(plan) == []


def test_a_situation_changes_nothing_while_the_policy_is_invalid() -> None:
    made = world()
    enter(made, "carrying")
    made.pods = [made.pods[0], standby(made, "w-hot", "hot")]
    made.build()
    broken = situational(("carrying", ("hot", "spare")))
    broken["spec"]["monitoring"]["yaml"] = {"topik": {}}
    made.others[0] = broken
    for situation in ("carrying", ""):
        enter(made, situation)
        plan = made.plan()
        assert order(plan) == ["hot", "spare", "Restart"]
        assert settings_of(plan).situation == "carrying"
        assert deleted(plan) == []


def test_a_situation_that_was_removed_from_the_policy_has_no_effect() -> None:
    made = world()
    enter(made, "carrying")
    made.pods.append(standby(made, "w-hot", "hot"))
    made.build()
    made.others[0] = situational(("parked", ("spare",)))
    assert order(made.plan()) == ["warm", "spare", "Restart"]
    assert covered(made) == ("True", "NoSituation")


def test_with_situations_the_own_pod_of_a_workload_does_not_replace_a_standby() -> None:
    """As whose standby it waited would change with the situation, and for a moment it would be nobody's."""
    made = world()
    enter(made, "carrying")
    made.pods = [standby(made, "w-hot", "hot")]
    made.own(gate(made.workload, active=made.pods[0], epoch=4))
    made.owned[("replicasets", "w")]["spec"]["replicas"] = 1
    plan = made.plan()
    assert pools_of(plan) == {"hot", "warm"}, (
        "until one of hot is ready beside the one that drives, one of warm is wanted"
    )
    assert patched(plan, "replicasets")["w"] == {"spec": {"replicas": 0}}
    assert settings_of(plan).situation is None, "the one that drives isn't its own standby"


def test_the_requirements_of_a_situation_choose_strategies_again() -> None:
    asked = auto(availability="Medium")
    asked["spec"]["situations"] = [{"name": "carrying", "when": WHEN, "requirements": {"taskCriticality": "High"}}]
    made = world(asked)
    assert order(made.plan()) == ["warm", "spare", "Restart"]
    enter(made, "carrying")
    plan = made.build()
    assert pools_of(plan) == {"hot"}
    assert order(plan) == ["warm", "spare", "Restart"]
    assert made.condition("StrategiesChosen")["message"].startswith(
        "Chosen order: 1. Initialized (warm), 2. Uninitialized (spare)"
    )
    made.pods.append(standby(made, "w-hot", "hot"))
    plan = made.build()
    assert order(plan) == ["hot", "warm", "spare", "Restart"]
    assert deleted(made.plan()) == []
    assert "taskCriticality High" in made.condition("StrategiesChosen")["message"]


def test_a_policy_without_situations_has_no_condition_about_them() -> None:
    made = world(policy("warm", "spare", "Restart"))
    made.workload["status"] = status_in("carrying")
    assert settings_of(made.plan()).strategies is None
    assert "SituationCovered" not in [one["type"] for one in made.status()["conditions"]]
    assert pools_of(made.plan()) == {"hot"}, "as ever, of each pool that serves it"


def test_a_missing_pool_of_a_situation_is_reported_with_its_path() -> None:
    (found,) = policy_status.conditions(CARRYING, {"warm": warm(), "spare": spare()}, {})
    assert (found.status, found.reason) == ("False", "PoolNotFound")
    assert_golden("operator", found.message, "spec.situations[0].strategies[0].poolRef.name", "FallbackPool", '"hot"')


def test_waiting_for_a_pool_that_is_not_shared_in_a_situation_is_reported_with_its_path() -> None:
    asked = situational(("carrying", ("hot",)))
    asked["spec"]["situations"][0]["strategies"][0]["waitFor"] = "5s"
    (found,) = policy_status.conditions(asked, {"hot": hot(), "warm": warm(), "spare": spare()}, {})
    assert_golden("operator", found.message, "spec.situations[0].strategies[0].waitFor", "FallbackPool")


def test_an_invalid_tree_of_a_situation_is_reported_with_its_path() -> None:
    asked = situational(("carrying", ("hot",)))
    asked["spec"]["situations"][0]["when"] = {"yaml": {"topik": {}}}
    found = policy_reader.problem(asked, {})
    assert found is not None
    assert_golden("operator", found.message, "spec.situations[0].when.yaml.topik", "'topik'")


async def test_a_pool_counts_no_standby_for_a_workload_whose_situation_does_not_use_it() -> None:
    class Nobody:
        async def find(self, *_: Any) -> None: ...
        async def list(self, *_: Any, **__: Any) -> Object:
            return {"items": []}

    store = Store()
    item = workload(status=status_in("", strategies="Initialized (warm), Uninitialized (spare), Restart"))
    for resource, found in ((WORKLOADS, item), (POLICIES, CARRYING), (POOLS, hot()), (POOLS, warm())):
        store.put(resource, found)
    observer = Observer(Nobody(), store, Expectations())
    assert (await observer.pool(hot())).spared == 1
    assert (await observer.pool(warm())).spared == 0


def test_the_pools_of_a_policy_include_those_of_its_situations() -> None:
    assert change_index.policy_reader.named_pools(CARRYING) == ["warm", "spare", "hot", "spare"]
    assert created(world().plan(), "pods") == []


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("enter"), st.sampled_from(["", "carrying", "lifting", "parked"])),
        st.tuples(st.just("ready"), st.sampled_from(["hot", "warm", "cold"])),
        st.tuples(st.just("look"), st.just("")),
    ),
    min_size=1,
    max_size=25,
)


@settings(deadline=None, max_examples=30)
@given(STEPS)
def test_no_sequence_of_situations_and_standbys_removes_protection(
    steps: list[tuple[str, str]],
) -> None:
    asked = situational(
        ("carrying", ("hot", "spare")), ("lifting", ("cold", "hot")), ("parked", ("spare",)), always=("warm",)
    )
    made = world(asked)
    made.others.append(warm("cold"))
    for kind, what in steps:
        if kind == "enter":
            enter(made, what)
        for pod in made.pods if kind == "ready" else ():
            if pod["metadata"]["labels"].get("understudy.dev/pool") == what:
                pod["status"]["conditions"] = [{"type": "Ready", "status": "True"}]
        before = _earlier_situations(made)
        assert made.condition("Protected")["status"] == "True"
        plan = made.build()
        gone = {name for name in deleted(plan) if name != "w-in-control"}
        taken = {
            pod["metadata"]["labels"].get("understudy.dev/pool") for pod in made.pods if kube_objects.name(pod) in gone
        }
        assert not taken & {*before, *order(plan)}, "the monitor may take one of them still"
        made.pods = [pod for pod in made.pods if kube_objects.name(pod) not in gone]
        made.pods += [
            {**pod, "status": {"phase": "Running"}, "metadata": {"uid": kube_objects.name(pod), **pod["metadata"]}}
            for pod in created(plan, "pods")
        ]
        assert made.condition("Protected")["status"] == "True"


def _earlier_situations(made: World) -> list[str]:
    """The pools of the strategies that the monitor got last, and Restart."""
    text = made.owned[("configmaps", "w-settings")]["data"]["settings.json"]
    strategies = WorkloadSettings.model_validate_json(text).strategies or []
    return [one.pool_ref.name if one.pool_ref is not None else one.type for one in strategies]
