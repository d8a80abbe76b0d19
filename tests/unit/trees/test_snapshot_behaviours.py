"""Snapshots as lists of behaviours, which py_trees itself rebuilds."""

from __future__ import annotations

import uuid
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.snapshot_trees import TREE, taken
from tests.unit.trees.tools import Row, drawn, rebuilt
from tests.unit.trees.world import World
from understudy.trees.core.snapshot_behaviours import NOBODY, Behaviour, behaviours, statuses

INVALID, RUNNING, SUCCESS, FAILURE = 1, 2, 3, 4


def rows(listed: list[Behaviour]) -> list[Row]:
    return [Row(n.id, n.parent, n.children, n.type, n.status, n.name, n.message) for n in listed]


def listed(world: World, now: float) -> dict[str, Behaviour]:
    found = behaviours(taken(world, now), "robot-1")
    rebuilt(rows(found))
    return {node.name: node for node in found}


def test_behaviours_have_types_and_states_and_py_trees_draws_them() -> None:
    world = World(TREE).hear("/scan", 1.0).battery(1.1, 0.8)
    found = behaviours(taken(world, 1.5), "robot-1")
    assert [(n.kind, n.type, n.status, n.active) for n in found] == [
        ("sequence", 2, SUCCESS, True),
        ("topic", 1, SUCCESS, True),
        ("while", 6, SUCCESS, True),
        ("topic", 1, INVALID, False),
        ("selector", 3, SUCCESS, True),
        ("value", 1, SUCCESS, True),
    ]
    assert found[2].message == "no goal of /go is active"
    assert found[2].detail == "while /go is active"
    lines = drawn(rebuilt(rows(found)))
    assert len(lines) == len(found)
    assert "scan" in lines[1]
    assert lines[2].endswith("-- no goal of /go is active")


def test_the_tip_of_each_node_is_the_leaf_that_decided() -> None:
    world = World(TREE).hear("/scan", 1.0).battery(1.1, 0.8)
    world.task = 1.2
    world.hear("/cmd_vel", 1.3)
    taken(world, 1.4)
    world.hear("/scan", 4.0)
    found = listed(world, 4.1)
    root, driving, leaf = found["sequence"], found["driving"], found["driving/cmd_vel"]
    assert (root.status, driving.status, leaf.status) == (FAILURE, FAILURE, FAILURE)
    assert_golden("health_tree", leaf.message, "/cmd_vel", "500 ms", "/go")
    assert root.current == driving.id
    assert root.tip == driving.tip == leaf.id
    assert driving.current == leaf.tip == NOBODY, "a decorator has no choice, and a leaf nothing below it"
    assert [found[name].active for name in ("scan", "selector", "battery.value")] == [True, False, False]


def test_the_id_of_a_node_is_stable_and_unique() -> None:
    world = World(TREE).hear("/scan", 1.0).battery(1.1, 0.8)
    first, second = behaviours(taken(world, 1.5), "robot-1"), behaviours(taken(world, 2.5), "robot-1")
    assert [n.id for n in first] == [n.id for n in second]
    assert statuses(first) != statuses(second)
    other = behaviours(taken(world, 2.5), "robot-2")
    assert not {n.id for n in first} & {n.id for n in other}
    renamed = behaviours({**taken(world, 2.5), "name": "health"}, "robot-1")
    assert renamed[0].id != first[0].id
    assert all(uuid.UUID(bytes=n.id).version == 4 for n in first)


def test_a_changed_message_alone_is_not_a_change() -> None:
    leaf = {"name": "scan", "kind": "topic", "state": "Failed", "reason": "/scan came at 7.9 Hz", "topic": "/scan"}
    one, two = behaviours(leaf, "w"), behaviours({**leaf, "reason": "/scan came at 7.8 Hz"}, "w")
    assert one != two
    assert statuses(one) == statuses(two)


def test_a_tree_without_watched_topics_has_one_behaviour_with_the_reason() -> None:
    (only,) = behaviours(None, "w")
    assert (only.status, only.active, only.parent) == (INVALID, False, NOBODY)
    assert "none of its topics can be watched" in only.message
    rebuilt(rows([only]))


STATES = st.sampled_from(["Healthy", "Starting", "Failed", "Idle", "Unasked", "Degraded"])
LEAF = st.fixed_dictionaries(
    {"name": st.sampled_from(["scan", "odom"]), "kind": st.just("topic"), "state": STATES, "reason": st.just("why")}
)


def _above(children: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    several = st.fixed_dictionaries(
        {
            "name": st.just("all"),
            "kind": st.sampled_from(["parallel", "sequence", "selector"]),
            "state": STATES,
            "reason": st.just(""),
            "children": st.lists(children, min_size=1, max_size=3),
        }
    )
    one = st.fixed_dictionaries(
        {
            "name": st.just("one"),
            "kind": st.sampled_from(["while", "inverter"]),
            "state": STATES,
            "reason": st.just(""),
            "task": st.just("/go"),
            "children": st.lists(children, min_size=1, max_size=1),
        }
    )
    return several | one


@given(st.recursive(LEAF, _above, max_leaves=12))
def test_py_trees_can_rebuild_every_tree(tree: dict[str, Any]) -> None:
    found = behaviours(tree, "w")
    root = rebuilt(rows(found))
    assert [node.id.bytes for node in _depth_first(root)] == [node.id for node in found]
    known = {node.id: node for node in found}
    for node in found:
        assert node.active == (node.status != INVALID)
        assert node.current in (NOBODY, *node.children)
        assert (node.tip == NOBODY) == (not node.children)
        assert node.tip == NOBODY or not known[node.tip].children


def _depth_first(node: Any) -> list[Any]:
    return [node, *(below for child in node.children for below in _depth_first(child))]
