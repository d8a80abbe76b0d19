"""Strategies that are left to be chosen: what is kept, what the monitor gets, and what the statuses report."""

from __future__ import annotations

import copy
import json

from tests.support.golden import assert_golden
from tests.unit.controller.strategy_policies import auto, order, pools_of, settings_of, warm, world
from tests.unit.controller.world import (
    World,
    applied,
    custom,
    deleted,
    gate,
    held_pod,
    hot,
    policy,
    spare,
    standby_pod,
    workload,
)
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.controller.observed import pool_reader
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.status import policy_status, pool_status
from understudy.kube.client import PODS, POLICIES, POOLS, WORKLOADS, Object


def recovered(by: str, seconds: float, times: int = 3) -> list[Object]:
    parts = {"detection": 0.5, "cluster": seconds, "startup": 0, "reinitialization": 0}
    return [
        {"id": f"{by}-{n}", "reason": "gone", "result": "Recovered", "strategy": by, "parts": parts}
        for n in range(times)
    ]


def test_the_monitor_receives_the_chosen_strategies_and_their_pools() -> None:
    plan = world().plan()
    assert order(plan) == ["warm", "spare", "Restart"]
    assert [choice.name for choice in settings_of(plan).pools] == ["warm", "spare"]
    strategies = settings_of(plan).strategies
    assert strategies is not None
    assert {one.verify_within for one in strategies} == {"10s"}


def test_no_strategies_are_chosen_if_the_policy_lists_them() -> None:
    assert settings_of(world(policy("hot", "Restart")).plan()).strategies is None


def test_no_standby_is_created_for_a_pool_that_was_not_chosen() -> None:
    assert pools_of(world().plan()) == {"warm"}
    assert pools_of(world(auto(taskCriticality="High")).plan()) == {"hot", "warm"}
    assert pools_of(world(auto(availability="Low")).plan()) == set()


def test_a_standby_of_a_pool_that_is_no_longer_chosen_is_deleted() -> None:
    made = world(auto(taskCriticality="High"))
    made.build()
    made.pods += [standby_pod("w-h", of=made.workload), standby_pod("w-w", of=made.workload, pool="warm")]
    made.others[0] = auto(availability="Low")
    assert deleted(made.plan()) == ["w-h", "w-w"]


def test_only_pools_that_serve_the_workload_and_are_not_empty_are_chosen() -> None:
    elsewhere = hot("elsewhere", workloadSelector={"matchLabels": {"task": "other"}})
    made = world(auto(taskCriticality="High"), elsewhere, hot("empty", per_workload=0), spare("none", replicas=0))
    assert order(made.plan()) == ["Restart"]


def test_a_pool_that_is_not_accepted_is_chosen_only_if_it_was_chosen_before() -> None:
    broken = warm(initialization={"yaml": {"set_lifecycle": {"node": "/nav", "state": "on"}}})
    made = world(auto(), broken, spare())
    assert order(made.plan()) == ["spare", "Restart"]
    made = world()
    made.build()
    made.others = [auto(), broken, spare()]
    assert order(made.plan()) == ["warm", "spare", "Restart"]


def test_recorded_recoveries_influence_the_choice() -> None:
    quick = {"recoveries": recovered("Restart", 1.1)}
    assert order(world(status=quick).plan()) == ["Restart", "spare"]
    assert order(world(status={"recoveries": recovered("Restart", 1.1, times=2)}).plan())[0] == "warm"


def test_the_order_does_not_change_during_a_recovery() -> None:
    made = world()
    made.build()
    made.workload["status"] = {"health": "Recovering", "recoveries": recovered("Restart", 1.1)}
    assert order(made.plan()) == ["warm", "spare", "Restart"]
    message = made.condition("StrategiesChosen")["message"]
    assert message.startswith("Chosen order: 1. Restart, 2. Uninitialized (spare). ")
    assert_golden("operator", message, "Initialized (warm), Uninitialized (spare), Restart")


def test_a_pool_that_is_added_after_a_failed_recovery_is_chosen() -> None:
    made = world(auto(), spare())
    made.build()
    made.own(gate(made.workload, epoch=4))
    made.workload["status"] = {"health": "Failed"}
    assert made.observed().recovering, "nobody is in control"
    made.others.append(warm())
    assert order(made.plan()) == ["warm", "spare", "Restart"]


def test_the_order_and_the_standbys_stay_while_the_policy_is_invalid_or_missing() -> None:
    made = world()
    made.build()
    made.pods.append(standby_pod("w-w", of=made.workload, pool="warm"))
    made.workload["status"] = made.status()
    bad = auto(availability="Low")
    bad["spec"]["monitoring"] = {"yaml": {"topik": {}}}
    for others in ([bad], []):
        made.others = [*others, hot(), warm(), spare()]
        plan = made.plan()
        assert order(plan) == ["warm", "spare", "Restart"]
        assert "hot" not in pools_of(plan)
        status = made.status()
        assert status["strategies"].split(", ") == ["Initialized (warm)", "Uninitialized (spare)", "Restart"]
        assert made.condition("StrategiesChosen")["message"].startswith("Chosen order: 1. Initialized (warm), ")


def test_a_new_template_does_not_wait_for_a_standby_of_a_pool_that_was_not_chosen() -> None:
    made = world(auto(availability="Low"))
    made.build()
    made.workload["spec"]["template"]["spec"]["containers"][0]["image"] = "app:2"
    assert "w" in applied(made.plan(), "replicasets")


def test_the_status_reports_the_chosen_order_and_the_reason() -> None:
    made = world()
    made.pods.append(standby_pod("w-w", of=made.workload, pool="warm"))
    status = made.status()
    assert status["strategies"].split(", ") == ["Initialized (warm)", "Uninitialized (spare)", "Restart"]
    assert status["standby"] == "Initialized (1/1)"
    condition = made.condition("StrategiesChosen")
    assert (condition["status"], condition["reason"]) == ("True", "Chosen")
    assert_golden("operator", condition["message"], "within 2 s", "availability Medium")
    assert "Left out: Executing (hot), because its standbys would use 96%" in condition["message"]
    assert_golden("operator", made.condition("Protected")["message"], "pool warm", "w-w (Initialized)")


def test_unmet_requirements_are_reported() -> None:
    condition = world(auto(availability="High", resourceUsage="Low")).condition("StrategiesChosen")
    assert (condition["status"], condition["reason"]) == ("False", "RequirementsNotMet")
    assert_golden("operator", condition["message"], "Executing (hot)")


def test_the_status_reports_listed_strategies_without_a_reason() -> None:
    status = world(policy("hot", "missing", "Restart")).status()
    assert status["strategies"] == "Executing (hot), Fallback (missing), Restart"
    assert "StrategiesChosen" not in [c["type"] for c in status["conditions"]]


def test_the_short_form_of_automatic_strategies_is_auto() -> None:
    assert policy_status.in_short(auto(), {"hot": hot()}) == "Auto"
    (condition,) = policy_status.conditions(auto(), {"hot": hot()}, {})
    assert condition.status == "True"


def test_the_order_of_the_objects_does_not_change_the_chosen_strategies() -> None:
    made = world(auto(taskCriticality="High"))
    expected = json.dumps(settings_of(made.plan()).to_wire())
    other = world(auto(taskCriticality="High"), *(copy.deepcopy(pool) for pool in (spare(), warm(), hot())))
    assert json.dumps(settings_of(other.plan()).to_wire()) == expected


def stored(*policies_and_workloads: Object) -> Store:
    store = Store()
    kinds = {"FailurePolicy": POLICIES, "FallbackPool": POOLS, "RobotWorkload": WORKLOADS}
    for item in (hot(), warm(), spare(), *policies_and_workloads):
        store.put(kinds[item["kind"]], item)
    return store


async def test_a_pool_counts_only_workloads_whose_strategies_use_it() -> None:
    written = custom("FailurePolicy", "written", policy("warm")["spec"])
    mine, other = workload("w"), workload("other", failurePolicyRef={"name": "written"})
    for item, asked in ((mine, auto()), (other, written)):
        item["status"] = World(item, asked, hot(), warm(), spare()).status()
    observer = Observer(None, stored(auto(), written, mine, other), Expectations())  # type: ignore[arg-type]
    for pool, desired in ((hot(), 1), (warm(), 2)):
        observed = await observer.pool(pool)
        assert pool_status.count(observed, pool_reader.spec(pool)).desired == desired


def test_a_change_of_a_pool_reconciles_workloads_with_automatic_strategies() -> None:
    store = stored(auto(), workload("w"))
    held = held_pod("s-1", of=spare())
    for change in (ObservedChange(POOLS, None, hot()), ObservedChange(PODS, None, held)):
        assert change_index.Key("robotworkloads", "fleet", "w") in change_index.of(change, store).keys


def test_a_change_of_the_chosen_order_reconciles_every_pool() -> None:
    store = stored(auto(), workload("w"))
    before, after = (
        workload("w", status={"strategies": "Restart"}),
        workload("w", status={"strategies": "Executing (hot)"}),
    )
    for old, new, expected in ((before, after, {"hot", "warm", "spare"}), (before, before, set())):
        found = change_index.of(ObservedChange(WORKLOADS, old, new), store).keys
        assert {key.name for key in found if key.plural == "fallbackpools"} == expected


def test_the_status_lists_at_most_eight_pools_with_a_ready_pod() -> None:
    # More of them than a status may have would be refused, and with them all that it says.
    many = [spare(f"spare-{n:02}") for n in range(12)]
    world = World(workload(), auto(), *many)
    world.unclaimed = {pool["metadata"]["name"]: [held_pod(f"h-{n}", of=pool)] for n, pool in enumerate(many)}
    world.build()
    found = world.status()
    assert found["stocked"] == [f"spare-{n:02}" for n in range(8)]
    RobotWorkloadStatus.model_validate(found)
