"""The leaf `parameter`: the value of a node's parameter."""

from __future__ import annotations

import math
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

NODE, SPEED = "/controller", "max_vel_x"


def leaf(**more: Any) -> dict[str, Any]:
    expected = {} if more.keys() & {"equals", "one_of", "between"} else {"equals": 0.26}
    return {"parameter": {"node": NODE, "name": SPEED, **expected, **more}}


def test_the_leaf_fails_when_the_parameter_changes():
    world = World(leaf()).set(SPEED, 1.0, 0.26)
    assert world.at(1.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.0) is None
    verdict = world.set(SPEED, 2.0, 0.5).at(2.0)
    assert verdict == Verdict("Failed", verdict.reason, "controller.max_vel_x.parameter", START + 1.0)
    assert_golden("health_tree", verdict.reason, "max_vel_x", "/controller", "0.26", "0.5")
    assert world.set(SPEED, 3.0, 0.26).at(3.0).state == "Healthy"
    assert (
        world.set(SPEED, 4.0, None, "it is not set")
        .at(4.0)
        .reason.startswith("parameter max_vel_x of node /controller is not set, but ")
    )


def test_with_for_the_leaf_fails_exactly_after_that_time_with_other_values():
    world = World(leaf(between="0.2 to 0.3", **{"for": "2s"})).set(SPEED, 1.0, 0.2)
    world.at(1.0)
    for time, value in ((1.1, 0.5), (1.2, 0.31), (2.5, 0.6)):
        assert world.set(SPEED, time, value).at(time).state == "Healthy"
        assert world.deadline(time) == 3.1
    assert_golden("health_tree", world.at(3.1).reason, "max_vel_x", "/controller", "0.2", "0.3", "2 s", "0.6")


def test_other_parameters_have_no_influence():
    other = {"parameter": {"node": NODE, "name": "label", "one_of": ["a", "b"], "for": "9s"}}
    world = World({"parallel": [leaf(), other]}).set(SPEED, 1.0, 0.26).set("label", 1.0, "b")
    world.at(1.0)
    assert world.set(SPEED, 2.0, 0.26).set("label", 2.0, "c").at(2.0).state == "Healthy"
    assert world.at(11.0).leaf == "controller.label.parameter"


@pytest.mark.parametrize(
    ("expected", "holding", "others"),
    [
        ({"equals": 1}, [1, 1.0, "1"], [True, 2, 1.5, "1.0", "one"]),
        ({"equals": "0.260"}, [0.26, "0.260"], [0.261, "0.26", False]),
        ({"equals": True}, [True, "true"], [False, 1, 1.0, "True"]),
        ({"equals": "False"}, [False, "False"], [True, 0, "false"]),
        ({"equals": "shop floor"}, ["shop floor"], ["shop", 0, 0.0, True]),
        ({"equals": 9007199254740993}, [9007199254740993], [9007199254740992]),
        ({"one_of": ["a", 2, 0.5]}, ["a", 2, 2.0, 0.5, "2"], ["b", 3, True]),
        ({"one_of": "a; 2 ;0.5"}, ["a", 2, 2.0, 0.5], ["b", " 2 "]),
        ({"between": "-1 to 2.5e0"}, [-1, 2.5, 0], [-1.001, 3, math.nan, math.inf, "0", True]),
        ({"between": [1, 2]}, [1, 2.0, 1.5], [0.999]),
    ],
)
def test_a_value_is_compared_by_the_type_of_the_parameter(expected, holding, others):
    for value in holding:
        assert World(leaf(**expected)).set(SPEED, 1.0, value).at(1.0).state == "Healthy", value
    for value in others:
        assert World(leaf(**expected)).set(SPEED, 1.0, value).at(1.0).state == "Starting", value


def test_a_node_that_is_brought_up_is_starting_until_the_grace_ends():
    world = World(leaf(), grace=10)
    assert_golden("health_tree", world.at(1.0).reason, "/controller", "max_vel_x", "10 s")
    assert_golden("health_tree", world.set(SPEED, 2.0, 0.1).at(9.9).reason, "max_vel_x", "/controller", "0.26", "0.1")
    assert world.deadline(9.9) == 10
    assert_golden("health_tree", world.at(10.0).reason, "max_vel_x", "/controller", "0.26", "10 s", "0.1")


def test_an_unknown_value_is_no_failure():
    world = World(leaf(), grace=5).set(SPEED, 1.0, None, reported=False)
    assert world.at(20.0).state == "Healthy"
    assert world.deadline(20.0) is None
    assert world.set(SPEED, 21.0, 0.5).at(21.0).state == "Failed"
    assert world.set(SPEED, 22.0, None, reported=False).at(22.0).state == "Healthy"


def test_the_next_instance_is_judged_only_by_observations_after_its_activation():
    world = World(leaf(), grace=10).set(SPEED, 1.0, 0.5)
    world.at(1.0)
    world.since = START + 3.0
    assert world.at(3.1).reason.startswith("waiting for the first answer")
    assert world.set(SPEED, 3.2, 0.26).at(3.2).state == "Healthy"


def test_a_leaf_of_a_task_is_judged_only_while_the_task_is_active():
    world = World({**TASK, "do": leaf()}, grace=5).set(SPEED, 100.0, 0.5)
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101
    assert world.at(101.0).reason.endswith(
        " is 0.5, but a value equal to 0.26 is required while a goal of /go is active"
    )


def test_the_parameter_events_are_watched_once_for_all_parameters():
    (topic,) = load({"parallel": [leaf(), {"parameter": {"node": "/amcl", "name": "a", "equals": 1}}]}).topics
    assert (topic.name, topic.type, topic.reliable) == (
        "/parameter_events",
        "rcl_interfaces/msg/ParameterEvent",
        True,
    )
    assert topic.parameters == {(NODE, SPEED), ("/amcl", "a")}


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (
            NODE,
            "",
            "found '/controller'; 'parameter' must be a mapping such as {node: /controller_server, name: max_vel_x, "
            "equals: 0.26}",
        ),
        (
            {"name": "a", "equals": 1},
            ".node",
            "missing; give the node's fully qualified name, such as /controller_server",
        ),
        ({"node": "amcl", "name": "a", "equals": 1}, ".node", "found 'amcl'; did you mean '/amcl'?"),
        ({"node": NODE, "equals": 1}, ".name", "missing; give the parameter's name, such as max_vel_x"),
        (
            leaf(name="max vel")["parameter"],
            ".name",
            "found 'max vel'; give a parameter's name such as max_vel_x or FollowPath.max_vel_x",
        ),
        (
            {"node": NODE, "name": "a"},
            "",
            "found none of equals, one_of and between; give one of them, such as equals: 0.26",
        ),
        (
            leaf(equals=1, between="1 to 2")["parameter"],
            "",
            "found equals and between; give one of them, such as equals: 0.26",
        ),
        (
            leaf(equals=[1])["parameter"],
            ".equals",
            "found a list; give a number, a text of up to 256 characters, true or false",
        ),
        (
            leaf(equals=math.nan)["parameter"],
            ".equals",
            "found nan, which no parameter can be compared with; give a number",
        ),
        (
            leaf(one_of=[])["parameter"],
            ".one_of",
            "found a list; give a list of 1 to 32 values, or a text with ';' between them",
        ),
        (
            leaf(between="2 to 1")["parameter"],
            ".between",
            "found '2 to 1'; give the least and the greatest number, such as 0.2 to 0.3",
        ),
        (
            leaf(between=3)["parameter"],
            ".between",
            "found 3; give the least and the greatest number, such as 0.2 to 0.3",
        ),
        (
            leaf(value=1)["parameter"],
            ".value",
            "unknown key 'value'; known are node, name, equals, one_of, between, for",
        ),
        (
            leaf(**{"for": 2})["parameter"],
            ".for",
            "found 2, which has no unit; write it with ms, s, m or h, such as 500ms",
        ),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("parameter", found) == [f"{place}: {expected}"]


def test_the_leaf_is_the_same_in_all_languages():
    short = {
        "parallel": [
            leaf(**{"for": "1s"}),
            {**leaf(one_of="0.1; 0.26"), "name": "some"},
            {**leaf(between="0.2 to 0.9"), "name": "band"},
        ]
    }
    ports = f'node="{NODE}" parameter="{SPEED}"'
    text = written(
        f'<Parameter {ports} equals="0.26" for="1s"/><Parameter name="some" {ports} one_of="0.1; 0.26"/>'
        f'<Parameter name="band" {ports} between="0.2 to 0.9"/>'
    )

    def drive(world):
        for time, value in ((1, 0.26), (2, 0.1), (3, 0.26), (4, 0.5), (6, 0.26)):
            world.set(SPEED, time, value)
            yield from (world.at(time), world.deadline(time))

    states = states_in_both_forms(text, short, drive)
    assert states == ["Starting", "Healthy", "Failed", "Healthy", "Failed", "Healthy"]
    with pytest.raises(TreeError) as caught:
        load_xml(written(f'\n<Parameter node="{NODE}" parameter="a b" equals="1"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "max_vel_x",
        "FollowPath",
    )


scalars = (
    st.booleans()
    | st.integers(-(10**20), 10**20)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=20)
)


@settings(max_examples=300, deadline=None)
@given(value=scalars)
def test_a_value_equals_its_own_text(value):
    assume(not isinstance(value, str) or value.isprintable())
    for expected in (value, str(value)):
        assert World(leaf(equals=expected)).set(SPEED, 1.0, value).at(1.0).state == "Healthy"


@settings(max_examples=100, deadline=None)
@given(
    node=st.sampled_from([leaf(), leaf(**{"for": "1s"}), {"inverter": leaf(**{"for": "700ms"})}]),
    changes=st.lists(st.tuples(st.integers(0, 600), st.sampled_from([0.26, 0.5, None, "unknown"])), max_size=12),
    tasked=st.booleans(),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, changes, tasked, task, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, value in sorted(changes, key=lambda one: one[0]):
        if time <= now:
            known = value != "unknown"
            world.set(SPEED, time / 100, value if known else None, reported=known).at(time / 100)
    assert_deadline_is_the_first_worse_moment(world, now / 100)
