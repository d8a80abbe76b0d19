"""A pool's size follows the failures of the robots that take from it: counted from statuses, kept in the pool's own, told once."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.pools import condition, observe, plan, present, status
from tests.unit.controller.world import IMAGES, NOW, created, deleted, held_pod, policy, spare, stamp, workload
from understudy.advice.adaptive_size import REST
from understudy.controller.pods import pool_pods, pool_size
from understudy.controller.pods.pool_size import RobotHistory
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.observer import Observer
from understudy.kube.client import POLICIES, POOLS, WORKLOADS, Object

HOUR = 3600.0


def sized(**sizing: Any) -> Object:
    """A pool whose size follows the failures."""
    made = spare(
        sizing={"risk": "1%", "riskOf": "Loss", "refill": "30s", "history": "24h", "min": 1, "max": 20} | sizing
    )
    del made["spec"]["replicas"]
    return made


def failed(*ago: float, strategy: str = "Fallback/Uninitialized", pod: str = "spare-x7k2q") -> list[Object]:
    """The record of recoveries, newest first."""
    return [
        {
            "id": f"at-{moment}",
            "result": "Recovered",
            "moments": {"detected": stamp(NOW - moment)},
            "attempts": [{"strategy": strategy, "pod": pod, "result": "Verified"}],
        }
        for moment in ago
    ]


def robot(name: str = "w", *recoveries: Object, age: float = 10 * HOUR, count: int | None = None) -> Object:
    found = workload(name, status={"recoveries": list(recoveries), "recoveryCount": count or len(recoveries)})
    found["metadata"]["creationTimestamp"] = stamp(NOW - age)
    return found


def history_of(*asking: Object, history: float = 24 * HOUR) -> RobotHistory:
    return pool_size.robot_history("spare", asking, NOW - history, NOW)


def observed(pool: Object, *asking: Object, now: float = NOW, pods: list[Object] | None = None) -> pool_pods.Observed:
    return replace(observe(pool, pods or [], workloads=asking, now=now), asking=asking)


def kept(size: int, *, since: float = NOW) -> Object:
    """A pool's status with a size that was decided before."""
    rest = {"needed": 1, "robots": 1, "failures": 0, "robotHours": 1, "failuresPerRobotHour": 1, "low": 0.05, "high": 3}
    return {"sizing": {"size": size, "lastChange": stamp(since), **rest}}


def with_status(pool: Object, *asking: Object, now: float = NOW) -> Object:
    """The pool as its next status makes it."""
    return pool | {"status": status(observed(pool, *asking, now=now))}


class TestHistory:
    def test_robots_that_never_failed_are_observed_from_their_creation(self) -> None:
        assert history_of(robot("a", age=2 * HOUR), robot("b", age=4 * HOUR)) == RobotHistory(2, 0, pytest.approx(6.0))

    def test_a_failure_that_took_a_pod_of_the_pool_counts(self) -> None:
        assert history_of(robot("a", *failed(100, 200))).failures == 2

    def test_a_failure_that_found_the_pool_empty_counts(self) -> None:
        assert history_of(robot("a", *failed(100, pod=""))).failures == 1

    @pytest.mark.parametrize(
        "other",
        [
            {"strategy": "Restart"},
            {"strategy": "Fallback/Executing"},
            {"pod": "spare-big-x7k2q"},
            {"pod": "other-x7k2q"},
        ],
    )
    def test_a_failure_that_used_another_strategy_or_pool_does_not_count(self, other: Any) -> None:
        assert history_of(robot("a", *failed(100, **other))).failures == 0

    def test_failures_and_robot_hours_before_the_history_do_not_count(self) -> None:
        found = history_of(robot("a", *failed(100, 3 * HOUR)), history=2 * HOUR)
        assert found == RobotHistory(1, 1, pytest.approx(2.0))

    def test_if_a_status_lost_old_failures_only_the_time_it_covers_counts(self) -> None:
        ten = failed(*(360.0 * number for number in range(1, 11)))
        assert history_of(robot("a", *ten, count=40)) == RobotHistory(1, 9, pytest.approx(1.0))
        assert history_of(robot("a", *ten, count=10)) == RobotHistory(1, 10, pytest.approx(10.0))

    def test_a_failure_record_of_another_version_is_ignored(self) -> None:
        assert history_of(robot("a", {"id": "x", "result": "Recovered"})).failures == 0


class TestSize:
    def test_a_fleet_without_failures_is_sized_by_the_assumed_rate(self) -> None:
        fleet = [robot(f"w{n}", age=0) for n in range(100)]
        found = status(observed(sized(failuresPerRobotHour=2.0), *fleet))
        assert found["sizing"]["failuresPerRobotHour"] == 2.0
        assert found["desired"] == found["sizing"]["size"] == found["sizing"]["needed"] == 6
        assert len(created(plan(observed(sized(failuresPerRobotHour=2.0), *fleet)), "pods")) == 6

    def test_a_pool_grows_at_once_when_robots_fail(self) -> None:
        quiet, before = [robot(f"w{n}") for n in range(10)], sized(failuresPerRobotHour=0.01)
        before = with_status(before, *quiet)
        loud = [robot(f"w{n}", *failed(10, 20, 30, 40, 50, 60)) for n in range(10)]
        after = with_status(before, *loud)
        assert after["status"]["sizing"]["size"] > before["status"]["sizing"]["size"]
        assert after["status"]["sizing"]["failures"] == 60

    def test_a_pool_shrinks_late_and_one_by_one(self) -> None:
        pool = with_status(sized(failuresPerRobotHour=30.0), robot("w", age=0))
        size = pool["status"]["sizing"]["size"]
        assert size > 2
        calm = robot("w", age=-REST)
        for later, expected in ((REST - 1, size), (REST, size - 1), (2 * REST - 1, size - 1), (2 * REST, size - 2)):
            # The same robot, a day older: nothing of it has failed.
            calm["metadata"]["creationTimestamp"] = stamp(NOW - 24 * HOUR)
            pool = with_status(pool, calm, now=NOW + later)
            assert pool["status"]["sizing"]["size"] == expected

    def test_a_smaller_size_deletes_one_pod(self) -> None:
        pool = sized()
        pool["status"] = kept(3, since=NOW - REST)
        pods = [held_pod(f"spare-{n}", of=pool, template_hash=present(pool)) for n in range(3)]
        calm = observed(pool, robot("w", age=24 * HOUR), pods=pods)
        assert len(deleted(plan(calm))) == 1

    def test_a_new_operator_continues_with_the_size_in_the_status(self) -> None:
        pool = sized()
        pool["status"] = kept(7, since=NOW - 60)
        assert status(observed(pool, robot("w")))["desired"] == 7
        assert status(observed(pool, robot("w")))["sizing"]["lastChange"] == stamp(NOW - 60)

    def test_the_reserve_is_added_to_the_size(self) -> None:
        fleet = [robot(f"w{n}", age=0) for n in range(100)]
        plain, kept = sized(), sized()
        kept["spec"]["reserve"] = {"pods": 2, "poolPriority": 100}
        assert status(observed(kept, *fleet))["desired"] == status(observed(plain, *fleet))["desired"] + 2

    def test_a_quiet_pool_is_reconciled_again_because_quiet_time_is_evidence(self) -> None:
        pool = sized(min=0)
        pool["status"] = kept(0)
        assert plan(observed(pool)).again_after == pool_size.RECALCULATE_AFTER

    def test_an_invalid_spec_keeps_the_last_decision(self) -> None:
        pool = with_status(sized(), robot("w"))
        before = pool["status"]["sizing"]
        pool["spec"]["sizing"]["max"] = -1
        assert status(observed(pool, robot("w")))["sizing"] == before
        assert plan(observed(pool, robot("w"))).writes == []

    def test_a_pool_without_sizing_has_the_size_of_its_spec(self) -> None:
        pool = spare(replicas=3)
        pool["status"] = kept(7)
        found = status(observed(pool, robot("w")))
        assert found["desired"] == pool_size.size(pool) == 3
        assert "sizing" not in found

    def test_a_pool_has_its_minimum_size_before_the_first_decision(self) -> None:
        assert pool_size.size(sized(min=2)) == 2
        assert pool_size.size(with_status(sized(min=2, max=2), robot("w"))) == 2


class TestCondition:
    def test_the_condition_explains_the_rate_and_the_size(self) -> None:
        fleet = [robot(f"w{n}", *(failed(100, 200) if n < 3 else ())) for n in range(12)]
        found = condition(observed(sized(), *fleet), "Sized")
        assert (found["status"], found["reason"]) == ("True", "Sized")
        assert_golden(
            "operator",
            found["message"],
            "12 robots",
            "6 times",
            "120 robot hours",
            "0.058",
            "0.027",
            "0.098",
            "30s",
            "1%",
            "1 pod",
        )

    def test_the_condition_explains_the_size_for_a_fleet_without_failures(self) -> None:
        found = condition(observed(sized(), robot("w", age=HOUR)), "Sized")
        assert_golden("operator", found["message"], "1 robot ", "1 robot hour", "the estimated rate is 0.5 ")

    def test_an_insufficient_maximum_is_reported_with_the_needed_size(self) -> None:
        fleet = [robot(f"w{n}", age=0) for n in range(300)]
        found = condition(observed(sized(max=3), *fleet), "Sized")
        assert (found["status"], found["reason"]) == ("False", "AtMaximum")
        assert_golden("operator", found["message"], "7 pods", "spec.sizing.max is 3")

    def test_an_insufficient_maximum_is_reported_until_it_is_certainly_sufficient(self) -> None:
        short = with_status(sized(max=3), *(robot(f"w{n}", age=0) for n in range(300)))
        fewer = [robot(f"w{n}", age=0) for n in range(20)]
        assert condition(observed(sized(max=3), *fewer), "Sized")["status"] == "True"
        assert condition(observed(short, *fewer), "Sized")["reason"] == "AtMaximum"
        assert condition(observed(short, *fewer[:2]), "Sized")["status"] == "True"

    def test_a_size_above_the_need_is_explained(self) -> None:
        pool = sized()
        pool["status"] = kept(5)
        sure = condition(observed(pool, robot("w", age=24 * HOUR)), "Sized")["message"]
        assert_golden("operator", sure, "5 pods", "10 minutes")
        pool["status"]["sizing"]["size"] = 4
        unsure = condition(observed(pool, *(robot(f"w{n}", age=60) for n in range(60))), "Sized")["message"]
        assert_golden("operator", unsure, "4 pods", "95%")
        least = condition(observed(sized(min=4), robot("w", age=24 * HOUR)), "Sized")["message"]
        assert_golden("operator", least, "4 pods", "spec.sizing.min")

    def test_a_day_without_failures_causes_few_status_writes(self) -> None:
        pool, writes = sized(), 0
        fleet = [robot(f"w{n}", age=0) for n in range(20)]
        for minute in range(24 * 60):
            new = status(observed(pool, *fleet, now=NOW + 60.0 * minute))
            writes += new["sizing"] != (pool.get("status") or {}).get("sizing")
            pool = pool | {"status": new}
        assert writes < 120

    def test_a_change_of_size_is_reported_once(self) -> None:
        pool = with_status(sized(), robot("w"))
        found = pool_size.sized(pool, pool_pods.evaluate(observed(pool), IMAGES).spec, [], NOW)  # type: ignore[arg-type]
        assert found is not None
        assert pool_size.change(found) is None
        pool["status"]["sizing"]["size"] = 0
        found = pool_size.sized(pool, pool_pods.evaluate(observed(pool), IMAGES).spec, [robot("w")], NOW)  # type: ignore[arg-type]
        assert found is not None
        text = pool_size.change(found)
        assert text is not None
        assert text.startswith("from 0 to 1 pods: 1 robot requested no pod")


class TestDemand:
    async def asking(self, asked: Object, *workloads: Object, pool: Object | None = None) -> list[str]:
        client: Any = None  # of a pool with a template of its own nothing is asked
        store, item = Store(), pool or sized()
        store.put(POOLS, item)
        store.put(POLICIES, asked)
        for one in workloads:
            store.put(WORKLOADS, one)
        found = await Observer(client, store, Expectations()).pool(item)
        return [one["metadata"]["name"] for one in found.asking]

    async def test_workloads_that_the_pool_serves_and_whose_policy_names_it_count(self) -> None:
        other = workload("other", labels={"task": "other"})
        assert await self.asking(policy("hot", "spare"), workload("w"), other) == ["w"]
        assert await self.asking(policy("hot", "Restart"), workload("w")) == []
        assert await self.asking(policy("spare", name="another"), workload("w")) == []

    async def test_workloads_for_which_the_pool_was_chosen_count(self) -> None:
        auto = policy("Restart")
        auto["spec"]["strategies"] = [{"type": "Auto"}]
        assert await self.asking(auto, workload("w", status={"strategies": "Uninitialized (spare), Restart"})) == ["w"]
        assert await self.asking(auto, workload("w", status={"strategies": "Restart"})) == []

    async def test_a_pool_of_fixed_size_reads_no_workloads(self) -> None:
        assert await self.asking(policy("spare"), workload("w"), pool=spare()) == []

    def test_only_a_recovery_in_a_workload_status_reconciles_the_pool(self) -> None:
        store, fixed = Store(), spare("fixed")
        for pool in (sized(), fixed):
            store.put(POOLS, pool)
        before, after = robot("w"), robot("w", *failed(1))
        key = Key(POOLS.plural, "fleet", "spare")
        assert change_index.of(ObservedChange(WORKLOADS, before, after), store).keys == {
            Key(WORKLOADS.plural, "fleet", "w"),
            key,
        }
        same = before | {"status": before["status"] | {"health": "Healthy"}}
        assert change_index.of(ObservedChange(WORKLOADS, before, same), store).keys == {
            Key(WORKLOADS.plural, "fleet", "w")
        }


def test_counting_a_thousand_robots_is_fast() -> None:
    fleet = [robot(f"w{n}", *failed(*range(60, 660, 60)), count=50) for n in range(1000)]
    started_at = time.process_time()
    history_of(*fleet)
    assert time.process_time() - started_at < 0.5
