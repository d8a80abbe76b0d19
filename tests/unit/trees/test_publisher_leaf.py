"""The leaf `publisher`: whose publishers count, when it fails, and what is watched for it."""

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

CMD, CONTROLLER, TELEOP = "/cmd_vel", "/controller", "/teleop"


def leaf(**more: Any) -> dict[str, Any]:
    return {"publisher": {"topic": CMD, **more}}


def test_the_leaf_fails_at_the_first_observation_without_a_publisher():
    world = World(leaf()).look(CMD, 1.0, CONTROLLER)
    assert world.at(1.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.0) is None
    verdict = world.look(CMD, 1.1).at(1.1)
    assert verdict == Verdict("Failed", verdict.reason, "cmd_vel.publisher", START + 1.0)
    assert_golden("health_tree", verdict.reason, "/cmd_vel", "no publisher")
    assert world.look(CMD, 1.2, "").at(1.2).state == "Healthy", "whose node isn't known yet counts too"


def test_with_for_the_leaf_fails_exactly_after_publishers_were_missing_for_that_time():
    world = World(leaf(**{"for": "2s"})).look(CMD, 1.0, CONTROLLER)
    world.at(1.0)
    for step in range(11, 30):
        assert world.look(CMD, step / 10).at(step / 10).state == "Healthy"
        assert world.deadline(step / 10) == 3.1
    assert_golden("health_tree", world.at(3.1).reason, "/cmd_vel", "2 s", "no publisher")
    world.look(CMD, 3.2, CONTROLLER).at(3.2)
    world.look(CMD, 3.3).at(3.3)
    world.look(CMD, 5.2, CONTROLLER).at(5.2)
    assert world.look(CMD, 5.3).at(6.0).state == "Healthy"


def test_other_nodes_and_topics_have_no_influence():
    world = World(leaf(node=CONTROLLER)).look(CMD, 1.0, CONTROLLER, TELEOP)
    assert world.at(1.0).state == "Healthy"
    assert world.look(CMD, 1.1, CONTROLLER).look("/scan", 1.1).at(1.1).state == "Healthy"
    assert_golden(
        "health_tree", world.look(CMD, 1.2, TELEOP, "").at(1.2).reason, "/cmd_vel", "/controller", "no publisher"
    )


def test_fewer_publishers_than_the_count_are_a_failure():
    world = World(leaf(count=3)).look(CMD, 1.0, CONTROLLER, CONTROLLER, TELEOP, TELEOP)
    assert world.at(1.0).state == "Healthy"
    assert_golden(
        "health_tree",
        world.look(CMD, 1.1, CONTROLLER, TELEOP).at(1.1).reason,
        "at least 3",
        "2 publishers of /cmd_vel",
    )
    world.look(CMD, 1.2, CONTROLLER, TELEOP, TELEOP).at(1.2)
    assert world.look(CMD, 1.3, TELEOP).at(1.3).reason.startswith("the instance has 1 publisher of /cmd_vel, but ")


def test_a_publisher_that_is_not_yet_discovered_is_starting_until_the_grace_ends():
    world = World(leaf(), grace=10)
    assert_golden("health_tree", world.at(1.0).reason, "/cmd_vel", "10 s")
    assert world.look(CMD, 1.1).at(9.9).state == "Starting"
    assert world.deadline(9.9) == 10
    assert_golden("health_tree", world.at(10.0).reason, "/cmd_vel", "10 s", "no publisher")
    assert world.look(CMD, 10.1, CONTROLLER).at(10.1).state == "Healthy"


def test_the_next_instance_is_judged_only_by_observations_after_its_activation():
    world = World(leaf(), grace=10).look(CMD, 1.0, CONTROLLER)
    world.at(1.0)
    assert world.look(CMD, 2.0).at(2.0).state == "Failed"
    world.since = START + 3.0
    assert world.at(3.1).state == "Starting"
    assert world.look(CMD, 3.2).at(3.2).state == "Starting"
    assert world.look(CMD, 3.3, CONTROLLER).at(3.3).state == "Healthy"


def test_a_clock_step_moves_remembered_times():
    world = World(leaf(**{"for": "1s"})).look(CMD, 1.0, CONTROLLER)
    world.at(1.0)
    world.look(CMD, 2.0).at(2.0)
    world.published[CMD].received += 3600.0
    assert world.at(3602.9).state == "Healthy"
    assert world.deadline(3602.9) == 3603


def test_a_leaf_of_a_task_is_judged_only_while_the_task_is_active():
    world = World({**TASK, "do": leaf()}, grace=5).look(CMD, 100.0)
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101
    assert world.at(101.0).reason.endswith(", but at least 1 is required while a goal of /go is active")
    world.task = None
    assert world.at(102.0).state == "Healthy"


def test_the_leaf_does_not_subscribe_to_its_topic():
    (alone,) = load(leaf()).topics
    assert (alone.subscribed, alone.publishers) == (False, True)
    gap = {"topic": {"name": CMD, "gap": "1s"}}
    for nodes in ([leaf(), gap], [gap, leaf()]):
        (both,) = load({"parallel": nodes}).topics
        assert (both.subscribed, both.publishers, both.type) == (True, True, None)


def test_publishers_are_counted_for_unreadable_topics_and_for_the_status_of_an_action():
    world = World({"parallel": [{"topic": {"name": CMD, "gap": "1s"}}, leaf()]}).look(CMD, 1.0, CONTROLLER)
    world.tree.leave_out({CMD})
    assert world.at(1.0).state == "Healthy"
    assert world.look(CMD, 1.1).at(1.1).state == "Failed"
    status = {"publisher": {"topic": "/go/_action/status"}}
    for nodes in ([status, {**TASK, "do": leaf()}], [{**TASK, "do": leaf()}, status]):
        found = {topic.name: topic for topic in load({"parallel": nodes}).topics}
        topic = found["/go/_action/status"]
        assert (topic.task, topic.subscribed, topic.publishers) == (True, True, True)
        for joined in (found[CMD].joined(topic), topic.joined(found[CMD])):
            assert joined.task


def test_the_leaf_does_not_require_messages_of_an_output():
    gap = {"topic": {"name": CMD, "gap": "1s"}}
    world = World({"parallel": [leaf(), {**TASK, "do": gap}]}).look(CMD, 1.0, CONTROLLER)
    observed = world.observed()
    assert world.tree.counting(observed, now=START + 1.0, since=START) == set()
    world.task = 0.5
    assert world.tree.counting(world.observed(), now=START + 1.0, since=START) == {CMD}


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (
            CMD,
            "",
            "found '/cmd_vel'; 'publisher' must be a mapping such as {topic: /cmd_vel, node: /controller_server}",
        ),
        ({}, ".topic", "missing; give the topic's fully qualified name, such as /cmd_vel"),
        ({"topic": "cmd_vel"}, ".topic", "found 'cmd_vel'; did you mean '/cmd_vel'?"),
        ({"topic": CMD, "node": "controller"}, ".node", "found 'controller'; did you mean '/controller'?"),
        (
            {"topic": CMD, "node": 3},
            ".node",
            "found 3; give a fully qualified node name such as /controller_server",
        ),
        ({"topic": CMD, "count": 0}, ".count", "found 0; give a whole number from 1 to 1000"),
        ({"topic": CMD, "count": True}, ".count", "found True; give a whole number from 1 to 1000"),
        ({"topic": CMD, "count": "two"}, ".count", "found 'two'; give a whole number from 1 to 1000"),
        ({"topic": CMD, "count": 1.5}, ".count", "found 1.5; give a whole number from 1 to 1000"),
        ({"topic": CMD, "for": 2}, ".for", "found 2, which has no unit; write it with ms, s, m or h, such as 500ms"),
        ({"topic": CMD, "nodes": "/a"}, ".nodes", "unknown key 'nodes', did you mean 'node'?"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("publisher", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {"parallel": [leaf(count=2, **{"for": "1s"}), {**leaf(node=CONTROLLER), "name": "controller"}]}
    text = written(
        '<Publisher topic="/cmd_vel" count="2" for="1s"/>'
        '<Publisher name="controller" topic="/cmd_vel" node="/controller"/>'
    )

    def drive(world):
        for time, nodes in ((1, (CONTROLLER, TELEOP)), (2, (CONTROLLER,)), (4, (TELEOP, TELEOP))):
            yield from (world.look(CMD, time, *nodes).at(time), world.deadline(time), world.at(time + 1.5))

    assert states_in_both_forms(text, short, drive) == [
        "Starting",
        "Healthy",
        "Healthy",
        "Healthy",
        "Failed",
        "Failed",
        "Failed",
    ]


def test_a_mistake_in_xml_is_reported_with_its_line():
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Publisher topic="/cmd_vel" count="none"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'none'",
        "1000",
    )


@settings(max_examples=150, deadline=None)
@given(
    node=st.sampled_from([leaf(), leaf(**{"for": "1s"}), {"inverter": leaf(**{"for": "700ms"})}]),
    looks=st.lists(st.tuples(st.integers(0, 600), st.booleans()), max_size=12),
    task=st.none() | st.integers(0, 600),
    tasked=st.booleans(),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, looks, task, tasked, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, there in sorted(looks):
        if time <= now:
            world.look(CMD, time / 100, *([CONTROLLER] if there else [])).at(time / 100)
    assert_deadline_is_the_first_worse_moment(world, now / 100)
