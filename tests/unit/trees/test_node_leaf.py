"""The leaf `node`: when it fails, and what is watched for it."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.world import START, TASK, World, mistakes, states_in_both_forms, written
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.languages.short.health_loader import TreeError, load

CONTROLLER = "/controller"


def leaf(**more: Any) -> dict[str, Any]:
    return {"node": {"name": CONTROLLER, **more}}


def test_the_leaf_fails_at_the_first_observation_without_the_node():
    world = World(leaf()).find(CONTROLLER, 1.0)
    assert world.at(1.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.0) is None
    verdict = world.find(CONTROLLER, 1.1, there=False).at(1.1)
    assert verdict == Verdict("Failed", "node /controller is gone", "controller.node", START + 1.0)
    assert world.find(CONTROLLER, 1.2).at(1.2).state == "Healthy"


def test_with_for_the_leaf_fails_exactly_after_the_node_was_missing_for_that_time():
    world = World(leaf(**{"for": "2s"})).find(CONTROLLER, 1.0)
    world.at(1.0)
    for step in range(11, 30):
        assert world.find(CONTROLLER, step / 10, there=False).at(step / 10).state == "Healthy"
        assert world.deadline(step / 10) == 3.1
    assert world.at(3.1).reason == "node /controller has been missing for 2 s"


def test_other_nodes_have_no_influence():
    world = World({"parallel": [leaf(), {"node": {"name": "/planner", "for": "5s"}}]})
    world.find(CONTROLLER, 1.0).find("/planner", 1.0)
    assert world.at(1.0).state == "Healthy"
    assert world.find(CONTROLLER, 1.1).find("/planner", 1.1, there=False).at(1.1).state == "Healthy"
    assert world.find(CONTROLLER, 1.2, there=False).find("/planner", 1.2).at(1.2).leaf == "controller.node"


def test_a_node_of_the_same_name_in_another_pod_does_not_count_and_is_reported():
    world = World(leaf()).find(CONTROLLER, 1.0)
    world.at(1.0)
    assert_golden("health_tree", world.find(CONTROLLER, 1.1, there=False, elsewhere=True).at(1.1).reason, "/controller")


def test_a_node_that_is_not_yet_discovered_is_starting_until_the_grace_ends():
    world = World(leaf(), grace=10)
    assert_golden("health_tree", world.at(1.0).reason, "/controller", "10 s")
    assert world.find(CONTROLLER, 1.1, there=False).at(9.9).reason == "node /controller is not there yet"
    assert world.deadline(9.9) == 10
    assert_golden("health_tree", world.at(10.0).reason, "/controller", "10 s")
    assert world.find(CONTROLLER, 10.1).at(10.1).state == "Healthy"


def test_the_next_instance_is_judged_only_by_observations_after_its_activation():
    world = World(leaf(), grace=10).find(CONTROLLER, 1.0)
    world.at(1.0)
    assert world.find(CONTROLLER, 2.0, there=False).at(2.0).state == "Failed"
    world.since = START + 3.0
    assert world.at(3.1).state == "Starting"
    assert world.find(CONTROLLER, 3.2, there=False).at(3.2).state == "Starting"
    assert world.find(CONTROLLER, 3.3).at(3.3).state == "Healthy"


def test_a_leaf_of_a_task_is_judged_only_while_the_task_is_active():
    world = World({**TASK, "do": leaf()}, grace=5).find(CONTROLLER, 100.0, there=False)
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101
    assert_golden("health_tree", world.at(101.0).reason, "/controller", "/go")
    world.task = None
    assert world.at(102.0).state == "Healthy"


def test_the_leaf_subscribes_to_no_topic_even_if_one_has_the_name_of_the_node():
    (alone,) = load(leaf()).topics
    assert (alone.name, alone.subscribed, alone.node) == (CONTROLLER, False, True)
    gap = {"topic": {"name": CONTROLLER, "gap": "1s"}}
    for nodes in ([leaf(), gap], [gap, leaf()]):
        (both,) = load({"parallel": nodes}).topics
        assert (both.subscribed, both.node, both.publishers) == (True, True, False)
    world = World({"parallel": [gap, leaf()]}).find(CONTROLLER, 1.0)
    world.tree.leave_out({CONTROLLER})
    assert world.at(1.0).state == "Healthy"
    assert world.find(CONTROLLER, 1.1, there=False).at(1.1).state == "Failed"


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (CONTROLLER, "", "found '/controller'; 'node' must be a mapping such as {name: /controller_server}"),
        ({}, ".name", "missing; give the node's fully qualified name, such as /controller_server"),
        ({"name": "controller"}, ".name", "found 'controller'; did you mean '/controller'?"),
        ({"name": 3}, ".name", "found 3; give a fully qualified node name such as /controller_server"),
        ({"name": "/a", "for": 2}, ".for", "found 2, which has no unit; write it with ms, s, m or h, such as 500ms"),
        ({"name": "/a", "gap": "2s"}, ".gap", "unknown key 'gap'; known are name, for"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("node", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {"parallel": [leaf(**{"for": "1s"}), {**leaf(), "name": "controller"}]}
    text = written('<Node node="/controller" for="1s"/><Node name="controller" node="/controller"/>')

    def drive(world):
        for time, there in ((1, True), (2, False), (4, True)):
            world.find(CONTROLLER, time, there=there)
            yield from (world.at(time), world.deadline(time), world.at(time + 0.5))

    assert states_in_both_forms(text, short, drive) == ["Starting", *["Healthy"] * 2, *["Failed"] * 2, *["Healthy"] * 2]
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Node node="controller"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'controller'",
        "'/controller'",
    )


@settings(max_examples=100, deadline=None)
@given(
    node=st.sampled_from([leaf(), leaf(**{"for": "1s"}), {"inverter": leaf(**{"for": "700ms"})}]),
    looks=st.lists(st.tuples(st.integers(0, 600), st.booleans()), max_size=12),
    tasked=st.booleans(),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, looks, tasked, task, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, there in sorted(looks):
        if time <= now:
            world.find(CONTROLLER, time / 100, there=there).at(time / 100)
    present = SEVERITY[world.at(now / 100).state]
    deadline = world.deadline(now / 100)
    later = [now / 100 + step / 100 for step in range(1, 500)]
    worse = next((time for time in later if SEVERITY[world.at(time).state] > present), None)
    if deadline is None:
        assert worse is None
    else:
        assert math.isclose(worse, deadline, abs_tol=0.011)
        assert SEVERITY[world.at(deadline + 1e-5).state] > present
        assert SEVERITY[world.at(deadline - 1e-5).state] <= present
