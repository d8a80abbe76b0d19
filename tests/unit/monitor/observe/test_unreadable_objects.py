"""A monitor keeps the last valid objects if somebody stores one that cannot be followed."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support.nested_values import DEPTHS, PLACE, list_of, text
from tests.unit.controller import world
from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.kube.client import CONFIG_MAPS, Object, Part
from understudy.kube.watched_collection import Reflector
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups


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


def change(copy: Reflector, item: Object, levels: int = 0) -> None:
    """Report a later version of an object, as the monitor's client reads it."""
    item["metadata"]["resourceVersion"] = "99"
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
