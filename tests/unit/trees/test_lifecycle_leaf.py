"""The leaf `lifecycle`: the state of a managed node."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.world import (
    START,
    TASK,
    World,
    assert_deadline_is_the_first_worse_moment,
    mistakes,
    states_in_both_forms,
    written,
)
from understudy.trees.core.health_tree import Verdict
from understudy.trees.languages.short.health_loader import TreeError, load

AMCL = "/amcl"


def leaf(**more: Any) -> dict[str, Any]:
    return {"lifecycle": {"node": AMCL, **more}}


def test_the_leaf_fails_when_the_node_leaves_its_state():
    world = World(leaf()).tell(AMCL, 1.0, "active")
    assert world.at(1.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.0) is None
    verdict = world.tell(AMCL, 2.0, "deactivating").at(2.0)
    assert verdict == Verdict("Failed", verdict.reason, "amcl.lifecycle", START + 1.0)
    assert_golden("health_tree", verdict.reason, "/amcl", "deactivating")
    assert world.tell(AMCL, 3.0, "active").at(3.0).state == "Healthy"
    assert world.tell(AMCL, 4.0, "").at(4.0).reason.startswith("node /amcl is not there, but ")


def test_with_for_the_leaf_fails_exactly_after_that_time_in_other_states():
    world = World(leaf(state="inactive", **{"for": "2s"})).tell(AMCL, 1.0, "inactive")
    world.at(1.0)
    for time, state in ((1.1, "activating"), (1.2, "active"), (2.5, "active"), (3.0, "deactivating")):
        assert world.tell(AMCL, time, state).at(time).state == "Healthy"
        assert world.deadline(time) == 3.1
    assert_golden("health_tree", world.at(3.1).reason, "/amcl", "2 s", "deactivating")


def test_other_nodes_have_no_influence():
    world = World({"parallel": [leaf(), {"lifecycle": {"node": "/map_server", "for": "9s"}}]})
    world.tell(AMCL, 1.0, "active").tell("/map_server", 1.0, "active").at(1.0)
    assert world.tell(AMCL, 2.0, "active").tell("/map_server", 2.0, "inactive").at(2.0).state == "Healthy"
    assert world.tell(AMCL, 3.0, "inactive").at(3.0).leaf == "amcl.lifecycle"


def test_a_node_that_is_brought_up_is_starting_until_the_grace_ends():
    world = World(leaf(), grace=10)
    assert_golden("health_tree", world.at(1.0).reason, "/amcl", "10 s")
    assert_golden("health_tree", world.tell(AMCL, 2.0, "unconfigured").at(9.9).reason, "/amcl", "unconfigured")
    assert world.deadline(9.9) == 10
    assert_golden("health_tree", world.at(10.0).reason, "/amcl", "10 s", "unconfigured")


def test_an_unknown_state_is_no_failure():
    world = World(leaf(), grace=5).tell(AMCL, 1.0, None)
    assert world.at(20.0).state == "Healthy"
    assert world.deadline(20.0) is None
    assert world.tell(AMCL, 21.0, "inactive").at(21.0).state == "Failed"
    assert world.tell(AMCL, 22.0, None).at(22.0).state == "Healthy"


def test_the_next_instance_is_judged_only_by_observations_after_its_activation():
    world = World(leaf(), grace=10).tell(AMCL, 1.0, "inactive")
    world.at(1.0)
    world.since = START + 3.0
    assert world.at(3.1).reason.startswith("waiting for the first answer")
    assert world.tell(AMCL, 3.2, "active").at(3.2).state == "Healthy"


def test_a_leaf_of_a_task_is_judged_only_while_the_task_is_active():
    world = World({**TASK, "do": leaf()}, grace=5).tell(AMCL, 100.0, "inactive")
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101
    assert world.at(101.0).reason == "node /amcl is inactive, but active is required while a goal of /go is active"


def test_the_transition_events_of_the_node_are_watched():
    (topic,) = load(leaf()).topics
    assert (topic.name, topic.type, topic.managed) == (
        "/amcl/transition_event",
        "lifecycle_msgs/msg/TransitionEvent",
        True,
    )


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (AMCL, "", "found '/amcl'; 'lifecycle' must be a mapping such as {node: /controller_server}"),
        ({}, ".node", "missing; give the node's fully qualified name, such as /controller_server"),
        ({"node": "amcl"}, ".node", "found 'amcl'; did you mean '/amcl'?"),
        ({"node": AMCL, "state": "activ"}, ".state", "found 'activ', did you mean 'active'?"),
        ({"node": AMCL, "state": 3}, ".state", "found 3; known are unconfigured, inactive, active, finalized"),
        ({"node": AMCL, "for": 2}, ".for", "found 2, which has no unit; write it with ms, s, m or h, such as 500ms"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("lifecycle", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {"parallel": [leaf(**{"for": "1s"}), {**leaf(state="active"), "name": "a"}]}
    text = written('<Lifecycle node="/amcl" for="1s"/><Lifecycle name="a" node="/amcl" state="active"/>')

    def drive(world):
        for time, state in ((1, "active"), (2, "inactive"), (4, "active")):
            world.tell(AMCL, time, state)
            yield from (world.at(time), world.deadline(time))

    assert states_in_both_forms(text, short, drive) == ["Starting", "Healthy", "Failed", "Healthy"]
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Lifecycle node="amcl"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'amcl'",
        "'/amcl'",
    )


@settings(max_examples=100, deadline=None)
@given(
    node=st.sampled_from([leaf(), leaf(**{"for": "1s"}), {"inverter": leaf(**{"for": "700ms"})}]),
    transitions=st.lists(
        st.tuples(st.integers(0, 600), st.sampled_from(["active", "inactive", "", None])), max_size=12
    ),
    tasked=st.booleans(),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, transitions, tasked, task, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, state in sorted(transitions, key=lambda one: one[0]):
        if time <= now:
            world.tell(AMCL, time / 100, state).at(time / 100)
    assert_deadline_is_the_first_worse_moment(world, now / 100)
