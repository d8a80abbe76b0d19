"""What workloads depend on: circles, names with nothing behind them, and what a monitor gets and may read."""

from __future__ import annotations

import json
from typing import Any, cast

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import IMAGES, World, applied, policy, workload
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.controller.desired.workload_plan import evaluate
from understudy.controller.observed import dependency_graph
from understudy.controller.observed.observation import Observed
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.status import workload_status
from understudy.kube.client import POLICIES, WORKLOADS, Client, Object

CIRCLE = {"a": ["b"], "b": ["c"], "c": ["a"], "d": ["a"], "e": []}
LADDER = {"control": ["localization", "planning"], "planning": ["localization"], "localization": []}


def needing(name: str, *others: str, **more: Any) -> Object:
    return workload(name, dependsOn=[{"name": other} for other in others], **more)


class TestCycles:
    @pytest.mark.parametrize("name", ["a", "b", "c"])
    def test_a_cycle_is_the_same_for_each_workload_in_it(self, name: str) -> None:
        assert dependency_graph.circle(CIRCLE, name) == ["a", "b", "c", "a"]

    def test_a_workload_that_only_depends_on_a_cycle_is_not_part_of_it(self) -> None:
        assert dependency_graph.circle(CIRCLE, "d") is None
        assert dependency_graph.first_circle(CIRCLE, "d") == ["a", "b", "c", "a"]

    def test_a_workload_that_depends_on_itself_is_a_cycle(self) -> None:
        assert dependency_graph.circle({"a": ["a"]}, "a") == ["a", "a"]

    def test_the_shortest_of_several_cycles_is_reported(self) -> None:
        known = {"a": ["b", "d"], "b": ["c"], "c": ["a"], "d": ["a"]}
        assert dependency_graph.circle(known, "a") == ["a", "d", "a"]
        assert dependency_graph.circle(known, "c") == ["a", "b", "c", "a"]

    def test_two_paths_to_one_workload_are_not_a_cycle(self) -> None:
        assert all(dependency_graph.circle(LADDER, name) is None for name in LADDER)

    def test_a_missing_dependency_is_not_a_cycle(self) -> None:
        assert dependency_graph.circle({"a": ["missing"]}, "a") is None


class TestOrder:
    def test_the_upstream_workloads_are_in_the_order_of_their_dependencies(self) -> None:
        found = dependency_graph.upstream(LADDER, "control")
        assert [(one.name, one.depends_on) for one in found] == [("localization", []), ("planning", ["localization"])]

    def test_indirect_dependencies_are_upstream(self) -> None:
        known = {"d": ["c"], "c": ["b"], "b": ["a"], "a": []}
        assert [one.name for one in dependency_graph.upstream(known, "d")] == ["a", "b", "c"]

    def test_a_missing_dependency_is_upstream(self) -> None:
        assert [one.name for one in dependency_graph.upstream({"a": ["later"]}, "a")] == ["later"]

    @pytest.mark.parametrize("name", ["a", "d"])
    def test_a_workload_with_a_cycle_has_no_upstream_workloads(self, name: str) -> None:
        assert dependency_graph.upstream(CIRCLE, name) == []

    def test_a_chain_of_300_workloads_is_resolved(self) -> None:
        known = {str(n): [str(n + 1)] for n in range(300)}
        assert len(dependency_graph.upstream(known, "0")) == 300


def resolved(known: dependency_graph.Graph, name: str) -> tuple[str, str, str]:
    (found,) = dependency_graph.resolved(known, workload(name))
    return found.status, found.reason, found.message


class TestCondition:
    @pytest.mark.parametrize("name", ["a", "b", "c"])
    def test_each_workload_of_a_cycle_reports_the_whole_cycle(self, name: str) -> None:
        status, reason, message = resolved(CIRCLE, name)
        assert (status, reason) == ("False", "DependencyCycle")
        assert "a -> b -> c -> a" in message
        assert "protected as if it had no dependency" in message

    def test_a_workload_that_depends_on_a_cycle_reports_it(self) -> None:
        assert "d depends on a cycle: a -> b -> c -> a" in resolved(CIRCLE, "d")[2]

    def test_a_workload_that_depends_on_itself_reports_it(self) -> None:
        assert "a depends on itself (a -> a)" in resolved({"a": ["a"]}, "a")[2]

    def test_a_missing_dependency_is_reported_with_a_similar_name(self) -> None:
        status, reason, message = resolved({"planning": ["localisation"], "localization": []}, "planning")
        assert (status, reason) == ("False", "DependencyNotFound")
        assert_golden("operator", message, 'RobotWorkload "localisation"', '"localization"')

    def test_resolved_dependencies_are_reported_in_order(self) -> None:
        assert resolved(LADDER, "control")[:2] == ("True", "Resolved")
        assert "localization, planning" in resolved(LADDER, "control")[2]

    def test_a_workload_without_dependencies_has_no_condition(self) -> None:
        assert dependency_graph.resolved(LADDER, workload("localization")) == []


class Nobody:
    """Nothing has to be asked."""


async def observed(item: Object, *others: Object) -> Observed:
    store = Store()
    store.put(POLICIES, policy("Restart"))
    for one in (item, *others):
        store.put(WORKLOADS, one)
    return await Observer(cast(Client, Nobody()), store, Expectations()).workload(item)


async def test_other_workloads_are_read_only_if_there_are_dependencies() -> None:
    other = needing("a", "b")
    assert (await observed(workload("w"), other)).dependencies == {}
    assert (await observed(needing("w", "a"), other)).dependencies == {"a": ["b"], "w": ["a"]}


async def test_a_dependency_that_is_being_deleted_is_missing() -> None:
    going = workload("a")
    going["metadata"]["deletionTimestamp"] = "2026-11-22T14:00:00Z"
    found = await observed(needing("w", "a"), going)
    status = workload_status.status(found, evaluate(found, IMAGES), [])
    assert "DependencyNotFound" in [one["reason"] for one in status["conditions"]]


def depending(known: dict[str, list[str]]) -> World:
    world = World(needing("w", *known["w"]), policy("Restart"))
    world.dependencies = known
    return world


def rights(world: World) -> list[str]:
    role = applied(world.plan(), "roles")["w-monitor"]
    (found,) = (rule["resourceNames"] for rule in role["rules"] if rule["resources"] == ["robotworkloads"])
    return list(found)


def settings(world: World) -> WorkloadSettings:
    data = applied(world.plan(), "configmaps")["w-settings"]["data"]
    return WorkloadSettings.model_validate(json.loads(data["settings.json"]))


def test_a_monitor_knows_and_may_read_only_the_upstream_workloads() -> None:
    world = depending({"w": ["b"], "b": ["a"], "a": [], "other": []})
    assert [one.name for one in settings(world).upstream] == ["a", "b"]
    assert rights(world) == ["w", "a", "b"]


def test_a_workload_in_a_cycle_is_protected_without_upstream_workloads() -> None:
    world = depending({"w": ["a"], "a": ["w"]})
    assert settings(world).upstream == []
    assert rights(world) == ["w"]
    assert world.condition("Accepted")["status"] == "True"
    assert world.condition("DependenciesResolved")["reason"] == "DependencyCycle"


def keys(old: Object | None, new: Object | None, *there: Object) -> set[str]:
    store = Store()
    for one in there:
        store.put(WORKLOADS, one)
    found = change_index.of(ObservedChange(WORKLOADS, old, new), store).keys
    return {key.name for key in found if key.plural == Key(WORKLOADS.plural, "", "").plural}


def later(item: Object) -> Object:
    return {**item, "metadata": {**item["metadata"], "generation": 4}}


class TestReconciledWorkloads:
    there = (needing("b", "c"), needing("c", "a"), workload("w"))

    def test_a_change_of_dependencies_reconciles_every_workload_with_dependencies(self) -> None:
        assert keys(workload("a"), later(needing("a", "b")), *self.there) == {"a", "b", "c"}

    def test_a_created_or_deleted_workload_reconciles_every_workload_with_dependencies(self) -> None:
        assert keys(None, workload("a"), *self.there) == {"a", "b", "c"}
        assert keys(workload("a"), None, *self.there) == {"a", "b", "c"}

    def test_another_change_reconciles_only_the_workload_itself(self) -> None:
        assert keys(workload("a"), later(workload("a")), *self.there) == {"a"}
