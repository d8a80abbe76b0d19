"""How a tree is, as plain values."""

from __future__ import annotations

from typing import Any

from tests.unit.trees.snapshot_trees import TREE, taken
from tests.unit.trees.world import START, World
from understudy.trees.core.snapshots import Snapshot, snapshot


def states(node: Snapshot) -> list[Any]:
    return [node["state"], *(states(child) for child in node.get("children", ()))]


def test_a_snapshot_contains_the_state_of_each_node_and_the_age_of_its_topic() -> None:
    world = World(TREE).hear("/scan", 1.0).hear("/scan", 1.2).battery(1.1, 0.8)
    found = taken(world, 1.5)
    assert states(found) == ["Healthy", ["Healthy"], ["Idle", ["Idle"]], ["Healthy", ["Healthy"]]]
    scan, driving, _ = found["children"]
    assert scan == {
        "name": "scan", "kind": "topic", "state": "Healthy", "reason": "", "topic": "/scan", "received": 2, "age": 0.3,
    }  # fmt: skip
    assert (driving["kind"], driving["task"]) == ("while", "/go")
    assert driving["children"][0]["age"] is None
    assert [found["kind"], *(child["kind"] for child in found["children"])] == [
        "sequence",
        "topic",
        "while",
        "selector",
    ]
    assert found["children"][2]["children"][0]["kind"] == "value"


def test_a_failed_leaf_has_a_reason_and_later_nodes_of_its_sequence_are_not_evaluated() -> None:
    world = World(TREE).hear("/scan", 1.0).battery(1.1, 0.8)
    taken(world, 1.5)
    found = taken(world, 2.5)
    assert states(found) == ["Failed", ["Failed"], ["Unasked", ["Unasked"]], ["Unasked", ["Unasked"]]]
    assert found["children"][0]["reason"] == "no /scan for 1 s"


def test_an_idle_node_is_shown_again_when_it_is_judged() -> None:
    world = World(TREE, grace=1.0).hear("/scan", 1.0).battery(1.1, 0.8)
    world.task = 1.2
    assert states(taken(world, 1.5))[2] == ["Healthy", ["Healthy"]], "it may take a moment to start"
    world.hear("/scan", 4.0)
    found = taken(world, 4.1)
    assert states(found)[2] == ["Failed", ["Failed"]]
    assert found["children"][1]["children"][0]["reason"] == "no /cmd_vel while a goal of /go is active"


def test_a_tree_without_watched_topics_has_no_snapshot() -> None:
    world = World({"topic": {"name": "/scan", "gap": "1s"}})
    world.tree.leave_out(["/scan"])
    assert snapshot(world.tree, world.observed(), START) is None


def test_both_forms_of_the_pod_leaf_have_the_kind_pod() -> None:
    world = World({"parallel": [{"pod": {"condition": "Ready"}}, {"pod": {"restarts": 1, "window": "1m"}}]})
    found = taken(world.pod_says(1.0, 0, Ready="True"), 1.5)
    assert [(child["name"], child["kind"]) for child in found["children"]] == [
        ("pod.Ready", "pod"),
        ("pod.restarts", "pod"),
    ]
