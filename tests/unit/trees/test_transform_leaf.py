"""The leaf `transform`: what keeps it alive and what doesn't, when it fails, and that its deadline is exact."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.support.ros_messages import Header, Stamp, TFMessage, TransformStamped
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


def leaf(**more: Any) -> dict[str, Any]:
    return {"transform": {"child": "base_link", "parent": "odom", "gap": "500ms", **more}}


def transform(parent: str, child: str, stamp: float = START) -> TransformStamped:
    """``stamp`` in Unix seconds, as whole milliseconds."""
    second, milli = divmod(round(stamp * 1000), 1000)
    return TransformStamped(Header(Stamp(second, milli * 1_000_000), parent), child)


def hear(world: World, time: float, *frames: tuple[str, str], late: float = 0.0, topic: str = "/tf") -> World:
    """A message with transforms (parent and child) that are so old when it is received."""
    transforms = [transform(parent, child, START + time - late) for parent, child in frames]
    return world.hear(topic, time, TFMessage(transforms=transforms))


BASE, WHEEL = ("odom", "base_link"), ("base_link", "wheel")


def test_the_leaf_fails_exactly_after_the_transform_was_missing_for_the_gap():
    world = hear(World(leaf()), 1.0, BASE)
    assert world.at(1.1) == Verdict("Healthy", "", "", None)
    assert world.deadline(1.1) == 1.5
    assert world.at(1.49999).state == "Healthy"
    assert world.at(1.5) == Verdict(
        "Failed", "no transform odom -> base_link on /tf for 500 ms", "base_link.transform", START + 1.0
    )
    assert hear(world, 2.0, BASE).at(2.0).state == "Healthy"


def test_other_transforms_on_the_topic_have_no_influence():
    world = hear(World(leaf()), 1.0, WHEEL, BASE, ("map", "odom"))
    world.at(1.0)
    for time in (1.1, 1.2, 1.3, 1.4):
        hear(world, time, WHEEL, ("map", "base_link"), ("odom", "base_link_2")).at(time)
    assert world.deadline(1.4) == 1.5
    assert world.at(1.5).reason == "no transform odom -> base_link on /tf for 500 ms"
    for step in range(20):
        world = hear(world, 2.0 + step / 10, BASE)
        assert world.at(2.0 + step / 10).state == "Healthy"
        assert hear(world, 2.05 + step / 10, WHEEL, late=3600.0).at(2.05 + step / 10).state == "Healthy"


def test_a_message_between_two_evaluations_counts_despite_later_ones():
    world = hear(World(leaf()), 1.0, BASE)
    world.at(1.0)
    hear(world, 1.4, BASE)
    for step in range(100):
        hear(world, 1.41 + step / 1000, WHEEL)
    assert world.at(1.52).state == "Healthy"
    assert world.deadline(1.52) == 1.9


def test_without_a_parent_any_parent_counts_and_a_leading_slash_is_ignored():
    world = World({"transform": {"child": "base_link", "gap": "500ms"}})
    assert hear(world, 1.0, ("/map", "/base_link")).at(1.4).state == "Healthy"
    assert world.at(1.5).reason == "no transform to base_link on /tf for 500 ms"
    assert hear(World(leaf()), 1.0, ("/odom", "/base_link")).at(1.0).state == "Healthy"


def test_at_most_fails_if_the_stamp_is_older_at_its_receipt():
    world = hear(World(leaf(at_most="300ms")), 1.0, BASE, late=0.3)
    assert world.at(1.2).state == "Healthy", "how long ago it was received is for the gap"
    hear(world, 1.3, WHEEL, late=10.0)
    assert world.at(1.3).state == "Healthy"
    verdict = hear(world, 1.4, BASE, late=0.4).at(1.4)
    assert verdict == Verdict("Failed", verdict.reason, "base_link.transform", START + 1.0)
    assert_golden("health_tree", verdict.reason, "300 ms", "base_link", "/tf", "400 ms")
    assert hear(world, 1.5, BASE, late=-1.0).at(1.5).state == "Healthy"
    world.hear("/tf", 1.6, TFMessage(transforms=[transform(*BASE, stamp=0.0)]))
    assert world.at(1.6).reason.endswith("cannot be determined: it has no stamp, but at most 300 ms is required")
    world.hear("/tf", 1.7, TFMessage(transforms=[transform(*BASE, START + at) for at in (1.69, 0.5)]))
    assert world.at(1.7).state == "Healthy", "the newest in a message counts"


def test_an_old_transform_ends_the_gap_and_with_for_a_single_one_is_no_failure():
    world = hear(World(leaf(at_most="300ms", **{"for": "1s"})), 1.0, BASE)
    for time in (1.4, 1.8, 2.2):
        assert hear(world, time, BASE, late=0.4).at(time).state == "Healthy"
    assert world.deadline(2.2) == 2.4
    assert world.at(2.4).reason.endswith(
        "on /tf arrived with an age of 400 ms, but at most 300 ms is required (violated for 1 s)"
    )
    assert hear(world, 2.5, BASE).at(2.5).state == "Healthy"
    assert hear(world, 2.6, BASE, late=0.4).at(2.6).state == "Healthy"
    assert world.deadline(2.6) == 3.1, "the gap comes first"
    assert world.at(3.1).reason == "no transform odom -> base_link on /tf for 500 ms"


def test_before_the_first_transform_the_leaf_is_starting_until_the_grace_ends():
    world = hear(World(leaf(at_most="300ms"), grace=10), 1.0, WHEEL)
    assert_golden("health_tree", world.at(1.0).reason, "base_link", "/tf", "10 s")
    assert world.deadline(1.0) == 10
    assert_golden("health_tree", world.at(10.0).reason, "base_link", "/tf", "10 s")
    hear(world, 2.0, BASE, late=1.0)
    assert world.at(9.999).state == "Starting"
    assert_golden("health_tree", world.at(10.0).reason, "10 s", "1 s")
    world.since = START + 20
    assert world.at(29.0).state == "Starting"
    assert hear(world, 30.5, BASE).at(30.5).state == "Healthy"


def test_an_unreadable_message_is_ignored():
    world = hear(World(leaf()), 1.0, BASE)
    assert world.hear("/tf", 1.2, "it is no TFMessage").hear("/tf", 1.3, object()).at(1.4).state == "Healthy"
    assert world.at(1.5).state == "Failed"


def test_a_clock_step_moves_remembered_times():
    world = hear(World(leaf()), 1.0, BASE)
    world.at(1.0)
    hear(world, 1.1, WHEEL).at(1.1)
    world.records["/tf"].shift(3600.0)
    assert world.at(3601.4).state == "Healthy"
    assert world.deadline(3601.4) == 3601.5


def test_for_a_task_the_gap_counts_from_the_start_of_the_task():
    world = hear(World({**TASK, "do": leaf()}, grace=5), 1.0, BASE)
    assert world.at(100.0).state == "Healthy"
    world.task = 100.0
    assert world.deadline(100.1) == 101, "it may settle"
    assert_golden("health_tree", world.at(101.0).reason, "base_link", "/tf", "500 ms", "/go")
    hear(world, 101.2, BASE)
    assert world.at(101.3).state == "Healthy"
    assert world.deadline(101.3) == 101.7


def test_the_leaf_subscribes_to_its_topic_and_is_named_after_its_child_frame():
    tree = load({"parallel": [leaf(), {"transform": {"child": "odom", "gap": "1s", "topic": "/robot/tf"}}]})
    assert [(t.name, t.type, t.contents, t.whole) for t in tree.topics] == [
        ("/tf", "tf2_msgs/msg/TFMessage", 256, True),
        ("/robot/tf", "tf2_msgs/msg/TFMessage", 256, True),
    ]
    assert [node.name for node in tree.root.iterate() if not node.children] == ["base_link.transform", "odom.transform"]


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (
            "base_link",
            "",
            "found 'base_link'; 'transform' must be a mapping such as {parent: odom, child: base_link, gap: 500ms}",
        ),
        ({"gap": "1s"}, ".child", "missing; give the child frame of the transform, such as base_link"),
        ({"child": "b"}, ".gap", "missing; give how long it may be missing, such as 500ms"),
        (
            {"child": "/b", "gap": "1s"},
            ".child",
            "found '/b'; frames have no slash in front, did you mean 'b'?",
        ),
        (
            {"child": "b", "parent": "a b", "gap": "1s"},
            ".parent",
            "found 'a b'; give a frame's name without spaces, such as base_link",
        ),
        ({"child": 7, "gap": "1s"}, ".child", "found 7; give a frame's name without spaces, such as base_link"),
        (
            {"child": "b", "parent": "b", "gap": "1s"},
            ".parent",
            "found 'b', which is also the child; give its parent frame, such as odom",
        ),
        (
            {"child": "b", "gap": 1},
            ".gap",
            "found 1, which has no unit; write it with ms, s, m or h, such as 500ms",
        ),
        (
            {"child": "b", "gap": "1s", "for": "1s"},
            ".for",
            "it is allowed only with at_most; give at_most, or remove 'for'. The key gap sets how long the transform may be missing",
        ),
        (
            {"child": "b", "gap": "1s", "topic": "/robot/tf_static"},
            ".topic",
            "found '/robot/tf_static': static transforms are published once, without a gap; give /tf",
        ),
        ({"child": "b", "gap": "1s", "atmost": "1s"}, ".atmost", "unknown key 'atmost', did you mean 'at_most'?"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("transform", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {"parallel": [leaf(at_most="300ms", **{"for": "200ms"}), {**leaf(topic="/robot/tf"), "name": "robot"}]}
    text = written(
        '<Transform parent="odom" child="base_link" gap="500ms" at_most="300ms" for="200ms"/>'
        '<Transform name="robot" topic="/robot/tf" parent="odom" child="base_link" gap="500ms"/>'
    )

    def drive(world):
        for time, late in ((1.0, 0.0), (1.2, 0.4), (1.3, 0.4), (1.7, 0.0)):
            hear(world, time, BASE, late=late)
            yield hear(world, time, BASE, topic="/robot/tf").at(time + 0.15)
            yield world.deadline(time + 0.15)
        yield world.at(2.2)

    assert states_in_both_forms(text, short, drive) == [
        "Starting",
        "Healthy",
        "Healthy",
        "Failed",
        "Healthy",
        "Failed",
    ]


def test_a_mistake_in_xml_is_reported_with_its_line():
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Transform child="/base_link" gap="1s"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'/base_link'",
        "'base_link'",
    )


NODES = st.sampled_from(
    [
        leaf(),
        leaf(at_most="300ms"),
        leaf(at_most="300ms", gap="1s", **{"for": "700ms"}),
        {"selector": [leaf(), {**leaf(gap="1s", at_most="300ms"), "name": "long"}]},
        {"inverter": leaf(at_most="300ms")},
    ]
)


@settings(max_examples=150, deadline=None)
@given(
    node=NODES,
    messages=st.lists(
        st.tuples(st.integers(0, 600), st.sampled_from([BASE, BASE, WHEEL]), st.sampled_from([0.0, 0.4])), max_size=12
    ),
    task=st.none() | st.integers(0, 600),
    tasked=st.booleans(),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, messages, task, tasked, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, frames, late in sorted(messages, key=lambda message: message[0]):
        if time <= now:
            hear(world, time / 100, frames, late=late).at(time / 100)
    assert_deadline_is_the_first_worse_moment(world, now / 100)
