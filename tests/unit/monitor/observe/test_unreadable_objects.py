"""A monitor keeps the last valid objects if somebody stores one that cannot be followed."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from tests.support.nested_values import DEPTHS, PLACE, list_of, text
from tests.unit.controller import world
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.kube.client import CONFIG_MAPS, Object, Part
from understudy.kube.watched_collection import Reflector
from understudy.monitor.observe.objects import long_trees
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups
from understudy.ros.runtime.interface_types import message_fields
from understudy.trees.languages import procedure_notations
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.languages.osc import grammar
from understudy.trees.languages.procedure_notations import composed
from understudy.trees.source import expressions

PROCEDURE = 'import osc.understudy\nscenario bring_up:\n    do serial:\n        wait_for("/scan", "sensor_msgs/msg/LaserScan")\n'


@pytest.fixture
def view() -> ClusterView:
    made = world.World(world.workload(), world.policy("Restart"))
    found = ClusterView(MemoryClient(), world.NAMESPACE, "w", Wakeups())
    found.workloads.put(made.workload)
    found.policies.put(world.policy("Restart"))
    found.settings_maps.put(world.applied(made.plan(), CONFIG_MAPS.plural)[names.settings("w")])
    assert found.spec is not None
    assert found.policy is not None
    assert found.settings is not None
    return found


def change(copy: Reflector, item: Object, levels: int = 0, version: str = "99") -> None:
    """Report a later version of an object, as the monitor's client reads it."""
    item["metadata"]["resourceVersion"] = version
    (found,) = Part.of(list_of("X", [text(item, levels)]).encode()).items()
    copy.apply_event("MODIFIED", found)


@pytest.mark.parametrize("levels", DEPTHS)
def test_deeply_nested_values_leave_the_last_spec_and_policy_in_force(view: ClusterView, levels: int) -> None:
    spec, policy = view.spec, view.policy
    deep: dict[str, Any] = {"sequence": PLACE}
    change(view.workloads, world.workload(bringUp={"yaml": deep}), levels)
    change(view.policies, world.policy("Restart", tree=deep), levels)
    assert view.spec is spec
    assert view.policy is policy


@pytest.mark.parametrize("rest", [{"data": {"settings.json": "[" * 5_000}}, {"data": {"other": ""}}, {"data": {}}, {}])
def test_settings_that_cannot_be_read_leave_the_last_ones_in_force(view: ClusterView, rest: Object) -> None:
    settings = view.settings
    change(view.settings_maps, {"metadata": {"name": names.settings("w")}, **rest})
    assert view.settings is settings


def long_policy(**status: Any) -> Object:
    """A policy with a valid tree that takes long to read."""
    found = world.policy("Restart")
    leaves = "".join(f"        topic('/a{index}', gap: 1s)\n" for index in range(200))
    text = f"import osc.understudy\nscenario main:\n    do parallel:\n{leaves}"
    found["spec"]["monitoring"] = {"osc": text}
    return found | {"status": status}


def accepted(reason: str, generation: int = 3) -> dict[str, Any]:
    condition = {"type": "Accepted", "status": str(reason == "Accepted"), "reason": reason}
    return {"observedGeneration": generation, "conditions": [condition]}


@pytest.mark.parametrize("status", [{}, accepted("Accepted", 2), accepted("TreeInvalid"), accepted("TreeTooCostly")])
def test_a_long_tree_that_the_operator_has_not_accepted_is_not_read(
    view: ClusterView, status: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading it takes up to seconds in which the monitor follows nothing else."""
    policy, spec = view.policy, view.spec
    monkeypatch.setattr(
        "understudy.monitor.observe.objects.cluster_view.composed", lambda *_, **__: pytest.fail("it was read")
    )
    change(view.policies, long_policy(**status))
    assert view.policy is policy
    change(view.workloads, world.workload(bringUp={"xml": "x" * 60_000}, status=status))
    assert view.spec == spec


@pytest.mark.parametrize("reason", ["Accepted", "PoolNotFound"])
def test_a_long_tree_is_followed_once_the_operator_has_judged_it(view: ClusterView, reason: str) -> None:
    change(view.policies, long_policy())
    judged = long_policy(**accepted(reason))
    judged["metadata"]["resourceVersion"] = "100"
    view.policies.apply_event("MODIFIED", judged)
    assert view.policy is not None
    assert view.policy.monitoring.osc


@pytest.fixture
def parsing(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """The threads in which OpenSCENARIO is parsed from now on."""
    found, parsed = set[int](), grammar._parsed
    grammar.parse.cache_clear()
    procedure_notations._composed.cache_clear()

    def noting(*arguments: Any) -> grammar.Part:
        found.add(threading.get_ident())
        return parsed(*arguments)

    monkeypatch.setattr(grammar, "_parsed", noting)
    return found


async def test_accepted_long_trees_are_parsed_by_another_thread(
    view: ClusterView, parsing: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes up to 0.3 s, in which the event loop would do nothing else."""
    policy, spec = view.policy, view.spec
    assert spec is not None
    async with asyncio.TaskGroup() as group:
        monkeypatch.setattr(view, "_group", group)
        view._referred = spec.failure_policy_ref.name  # its watch runs elsewhere
        change(view.policies, long_policy(**accepted("Accepted")))
        change(view.workloads, world.workload(bringUp={"osc": PROCEDURE}, pause={"reason": "a", "owner": "b"}))
        assert view.policy is policy
        assert view.spec is not None
        assert (view.spec.bring_up, view.spec.pause is None) == (None, False)
    assert view.policy is not None
    assert view.policy.monitoring.osc
    assert view.spec != spec
    assert view.spec.bring_up is not None
    composed(view.spec.bring_up, path="bringUp")
    assert len(load_monitoring(view.policy.monitoring).topics) == 200
    assert parsing
    assert threading.get_ident() not in parsing


LONG_CONDITION = "percentage > 0.15" + " or percentage > 0.15" * 20
"""Takes 0.3 ms to parse."""


def policy_with_conditions(number: int, **status: Any) -> Object:
    """A policy with conditions that all differ, in the short form."""
    found = world.policy("Restart")
    leaves = [
        {
            "value": {
                "topic": f"/a{index}",
                "type": "sensor_msgs/msg/BatteryState",
                "holds": f"{LONG_CONDITION} or voltage > {index}",
            }
        }
        for index in range(number)
    ]
    found["spec"]["monitoring"] = {"yaml": {"parallel": leaves}}
    return found | {"status": status}


async def test_many_long_conditions_are_parsed_by_another_thread(
    view: ClusterView, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand of them take 0.3 s, in which the event loop would do nothing else (fuzz seed 319940)."""
    policy, spec, threads, read = view.policy, view.spec, set[int](), expressions._read
    assert spec is not None
    expressions._condition.cache_clear()

    def noting(*arguments: Any) -> Any:
        threads.add(threading.get_ident())
        return read(*arguments)

    monkeypatch.setattr(expressions, "_read", noting)
    change(view.policies, policy_with_conditions(200))
    assert view.policy is policy, "the operator has not accepted them"
    async with asyncio.TaskGroup() as group:
        monkeypatch.setattr(view, "_group", group)
        view._referred = spec.failure_policy_ref.name  # its watch runs elsewhere
        change(view.policies, policy_with_conditions(200, **accepted("Accepted")), version="100")
        assert view.policy is policy
    assert view.policy is not policy
    assert view.policy is not None
    assert len(load_monitoring(view.policy.monitoring, fields=message_fields).topics) == 200
    assert len(threads) == 1
    assert threading.get_ident() not in threads


async def test_few_conditions_are_read_at_once(view: ClusterView) -> None:
    policy = view.policy
    change(view.policies, policy_with_conditions(20))
    assert view.policy is not policy


async def test_trees_that_cannot_be_read_are_not_followed(
    view: ClusterView, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The loop would end by an error that nobody foresaw."""
    policy = view.policy
    monkeypatch.setattr(long_trees, "load_inline", fail)
    for version in ("98", "99"):
        caplog.clear()
        change(view.policies, long_policy(**accepted("Accepted")), version=version)
        async with asyncio.TaskGroup() as group:
            monkeypatch.setattr(view, "_group", group)
            assert view.policy is policy
        assert view.policy is policy
        assert caplog.text.count("cannot be read") == 1


def fail(*_: Any, **__: Any) -> None:
    raise RuntimeError


def test_a_pause_applies_although_a_long_tree_beside_it_is_not_accepted(view: ClusterView) -> None:
    change(view.workloads, world.workload(bringUp={"xml": "x" * 60_000}, pause={"reason": "a", "owner": "b"}))
    assert view.spec is not None
    assert view.spec.pause is not None
    assert view.spec.bring_up is None
