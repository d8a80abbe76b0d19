"""What objects say alike is kept once, and says the same as before."""

from __future__ import annotations

import copy
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tests.unit.controller.world import workload
from understudy.api.nesting import MOST_VALUES
from understudy.controller.reconcile.interning import REMEMBERED_SECONDS, Interner
from understudy.controller.reconcile.object_store import Store
from understudy.kube.client import WORKLOADS, Object

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-2, 2) | st.floats(-2, 2) | st.sampled_from(["", "a", "b", "1", "true"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=12,
)


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def robot(name: str, **more: Any) -> Object:
    return {"metadata": {"name": name}, "spec": {"ports": [{"port": 1}], "env": {"name": "robot"}, **more}}


def alike(value: Any, other: Any) -> bool:
    """Equal, and of the same types: 1 isn't True."""
    if type(value) is not type(other):
        return False
    if isinstance(value, dict):
        return list(value) == list(other) and all(alike(value[key], other[key]) for key in value)
    if isinstance(value, list):
        return len(value) == len(other) and all(map(alike, value, other))
    return bool(value == other)


@given(st.lists(VALUES, max_size=5))
def test_interning_does_not_change_values(values: list[Any]) -> None:
    clock = Clock()
    sharing = Interner(clock=clock)
    for value in values:
        clock.now += REMEMBERED_SECONDS / 2
        assert alike(sharing.of({"spec": copy.deepcopy(value)}, None)["spec"], value)


def test_equal_parts_of_two_objects_are_stored_once() -> None:
    sharing = Interner(clock=Clock())
    one, two = sharing.of(robot("1", own="1"), None), sharing.of(robot("2", own="2"), None)
    assert one["spec"]["ports"] is two["spec"]["ports"]
    assert one["spec"]["env"] is two["spec"]["env"]
    assert (one["spec"]["own"], two["spec"]["own"]) == ("1", "2")
    assert one["metadata"] == {"name": "1"}


def test_a_new_version_of_an_object_shares_its_unchanged_parts_at_any_later_time() -> None:
    clock = Clock()
    sharing = Interner(clock=clock)
    old = sharing.of(robot("1"), None)
    clock.now += 10 * REMEMBERED_SECONDS
    assert sharing.of(robot("1"), old)["spec"] is old["spec"]
    changed = sharing.of(robot("1", more=True), old)
    assert changed["spec"]["more"] is True
    assert "more" not in old["spec"]


def test_parts_that_no_object_uses_are_forgotten() -> None:
    clock = Clock()
    sharing = Interner(clock=clock)
    first = sharing.of(robot("1"), None)
    assert sharing.of(robot("2"), None)["spec"]["ports"] is first["spec"]["ports"]
    for _ in range(2):
        clock.now += REMEMBERED_SECONDS
        sharing.of({"spec": "another"}, None)
    assert sharing.of(robot("2"), None)["spec"]["ports"] is not first["spec"]["ports"]


def test_a_store_keeps_equal_parts_of_its_objects_once() -> None:
    store = Store()
    for name in ("v", "w"):
        store.put(WORKLOADS, copy.deepcopy(workload(name)))
    one, two = (store.get(WORKLOADS, "fleet", name) for name in ("v", "w"))
    assert one is not None
    assert two is not None
    assert one["spec"]["template"] is two["spec"]["template"]
    assert one["spec"] == workload("v")["spec"]


def test_equal_owners_and_statuses_of_two_pods_are_stored_once() -> None:
    sharing = Interner(clock=Clock())
    owner = [{"kind": "RobotWorkload", "name": "w", "uid": "u"}]
    pods = [
        {
            "metadata": {"name": name, "labels": {"app": "w"}, "ownerReferences": copy.deepcopy(owner)},
            "status": {"phase": "Running"},
        }
        for name in ("w-1", "w-2")
    ]
    one, two = (sharing.of(pod, None) for pod in pods)
    assert one["status"] is two["status"]
    assert one["metadata"]["ownerReferences"] is two["metadata"]["ownerReferences"]
    assert [one["metadata"]["name"], two["metadata"]["name"]] == ["w-1", "w-2"]


def test_an_idle_store_forgets_the_parts_that_it_compared() -> None:
    clock = Clock()
    store = Store(clock=clock)
    store.put(WORKLOADS, copy.deepcopy(workload("v")))
    for _ in range(2):
        clock.now += REMEMBERED_SECONDS
        store.replace(WORKLOADS, [workload("v")], 0, None)
    store.put(WORKLOADS, copy.deepcopy(workload("w")))
    one, two = (store.get(WORKLOADS, "fleet", name) for name in ("v", "w"))
    assert one is not None
    assert two is not None
    assert one["spec"]["template"] is not two["spec"]["template"]


def test_the_parts_of_a_very_large_object_are_not_searched_for() -> None:
    """A search for 500,000 of them would keep the event loop busy for half a second."""
    sharing = Interner(clock=Clock())
    found = sharing.of({"metadata": {"name": "a"}, "spec": {str(i): i for i in range(MOST_VALUES + 1)}}, None)
    assert len(found["spec"]) == MOST_VALUES + 1
    assert not sharing._known
