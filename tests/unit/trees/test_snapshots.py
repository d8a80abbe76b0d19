"""How a tree is, as plain values."""

from __future__ import annotations

from typing import Any

from tests.unit.trees.snapshot_trees import TREE, taken
from tests.unit.trees.world import START, World
from understudy.trees.core.snapshots import Snapshot, snapshot


def states(node: Snapshot) -> list[Any]:
    return [node["state"], *(states(child) for child in node.get("children", ()))]


def test_a_healthy_tree_says_what_each_node_is_and_when_its_topic_came() -> None:
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


def test_a_failed_leaf_says_why_and_what_comes_after_it_in_a_sequence_was_not_asked() -> None:
    world = World(TREE).hear("/scan", 1.0).battery(1.1, 0.8)
    taken(world, 1.5)
    found = taken(world, 2.5)
    assert states(found) == ["Failed", ["Failed"], ["Unasked", ["Unasked"]], ["Unasked", ["Unasked"]]]
    assert found["children"][0]["reason"] == "no /scan for 1 s"


def test_what_is_judged_again_is_shown_again() -> None:
    world = World(TREE, grace=1.0).hear("/scan", 1.0).battery(1.1, 0.8)
    world.task = 1.2
    assert states(taken(world, 1.5))[2] == ["Healthy", ["Healthy"]], "it may take a moment to start"
    world.hear("/scan", 4.0)
    found = taken(world, 4.1)
    assert states(found)[2] == ["Failed", ["Failed"]]
    assert found["children"][1]["children"][0]["reason"] == "no /cmd_vel while a goal of /go is active"


def test_a_tree_of_which_nothing_can_be_watched_has_no_node() -> None:
    world = World({"topic": {"name": "/scan", "gap": "1s"}})
    world.tree.leave_out(["/scan"])
    assert snapshot(world.tree, world.observed(), START) is None


def test_both_leaves_about_the_pod_are_called_so() -> None:
    world = World({"parallel": [{"pod": {"condition": "Ready"}}, {"pod": {"restarts": 1, "window": "1m"}}]})
    found = taken(world.pod_says(1.0, 0, Ready="True"), 1.5)
    assert [(child["name"], child["kind"]) for child in found["children"]] == [
        ("pod.Ready", "pod"),
        ("pod.restarts", "pod"),
    ]
