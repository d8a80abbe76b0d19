"""The leaf `progress`: a goal that is active and doesn't get on."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.messages import GoFeedback, Pack
from tests.unit.trees.world import (
    ROOT,
    START,
    World,
    assert_deadline_is_the_first_worse_moment,
    states_in_both_forms,
    written,
)
from understudy.trees.core.health_tree import Verdict
from understudy.trees.languages.short.health_loader import TreeError, load
from understudy.trees.source.expression_values import Undefined
from understudy.trees.source.expressions import ExpressionError, Quantity

GO = "t/action/Go"
FALLS = {"type": GO, "falls": "distance_remaining", "by": 0.5, "within": "10s"}


def leaf(**more: Any) -> dict[str, Any]:
    return {"progress": {"action": "/go", **more}}


def world(*, task: float | None = 100.0, **more: Any) -> World:
    """Of an instance that has been there for long, with a goal that became active then."""
    judged = World(leaf(**more), grace=5.0)
    judged.task = task
    return judged


def drive(judged: World, *distances: tuple[float, float], goal: int = 1) -> list[str]:
    return [judged.feed_back(t, goal, distance_remaining=d).at(t).state for t, d in distances]


def test_the_leaf_fails_exactly_after_the_distance_has_not_fallen_for_that_time():
    judged = world(**FALLS)
    assert drive(judged, (100.5, 9.0), (105.0, 8.4), (108.0, 8.0), (112.0, 7.95)) == ["Healthy"] * 4
    assert judged.deadline(112.0) == 115.0, "since 8.4 it has fallen by 0.45"
    assert judged.feed_back(114.9, distance_remaining=7.92).states([114.9]) == ["Healthy"]
    verdict = judged.at(115.0)
    assert verdict == Verdict("Failed", verdict.reason, "go.progress", START + 105.0)
    assert_golden("health_tree", verdict.reason, "distance_remaining", "/go", "0.5", "10 s", "8.4")
    assert drive(judged, (115.5, 7.9)) == ["Healthy"]


def test_a_robot_that_backs_up_and_retries_makes_no_progress():
    judged = world(**FALLS)
    states = drive(judged, *[(100.5 + step, 9.0 if step % 2 else 9.8) for step in range(11)])
    assert states == [*["Healthy"] * 11], "9.8, then 9.0 at 101.5"
    assert judged.states([111.4, 111.5]) == ["Healthy", "Failed"]


def test_with_grows_an_increase_is_progress():
    judged = world(type=GO, grows="number_of_recoveries * 2", by=2, within="3s")
    for time, number in ((100.5, 0), (102.0, 1), (104.0, 2), (106.0, 1)):
        assert judged.feed_back(time, number_of_recoveries=number).at(time).state == "Healthy"
    assert_golden("health_tree", judged.at(107.0).reason, "number_of_recoveries", "/go", "3 s")


def test_without_a_goal_no_progress_is_required():
    judged = world(task=None, gap="1s", **FALLS)
    assert judged.at(100.0) == Verdict("Healthy", "", "", None)
    assert judged.deadline(100.0) is None
    judged.task = 200.0
    assert drive(judged, (200.5, 3.0)) == ["Healthy"]
    judged.task = None
    assert judged.at(300.0).state == "Healthy", "it has arrived"


def test_a_gap_ignores_the_contents_of_feedback_and_fails_with_silence():
    judged = world(gap="2s")
    assert judged.deadline(100.0) == 102.0, "it may be silent for as long from the start of the goal"
    for time in (101.0, 102.5, 104.0):
        assert judged.hear("/go/_action/feedback", time, "unreadable").at(time).state == "Healthy"
    assert judged.deadline(104.0) == 106.0
    verdict = judged.at(106.0)
    assert verdict == Verdict("Failed", verdict.reason, "go.progress", START + 104.0)
    assert_golden("health_tree", verdict.reason, "/go", "2 s")


def test_other_feedback_topics_have_no_influence():
    judged = World(
        {"parallel": [leaf(gap="2s"), {"topic": {"name": "/other/_action/feedback", "gap": "60s"}}]}, grace=5
    )
    judged.task = 100.0
    for time in (101.0, 102.9):
        judged.feed_back(time)
        assert judged.hear("/other/_action/feedback", time).at(time).state == "Healthy"
    assert judged.hear("/other/_action/feedback", 104.9).at(104.9).leaf == "go.progress"


def test_the_first_failure_of_gap_and_distance_is_reported():
    judged = world(gap="2s", **FALLS)
    drive(judged, (100.5, 9.0))
    assert judged.at(102.5).reason.startswith("no feedback of /go for 2 s")
    for step in range(20):
        drive(judged, (102.5 + step / 2, 9.0))
    assert_golden("health_tree", judged.at(112.5).reason, "distance_remaining", "/go", "0.5", "10 s")


def test_a_new_goal_starts_a_new_measurement():
    judged = world(**FALLS)
    drive(judged, (100.5, 1.0))
    assert drive(judged, (109.0, 20.0), goal=2) == ["Healthy"], "the goal was replaced by one that is farther away"
    assert judged.deadline(109.0) == 119.0
    assert drive(judged, (118.0, 0.1), goal=1) == ["Healthy"], "two at once: one of them gets on"
    judged.task = 130.0
    assert judged.states([131.9, 135.0]) == ["Healthy"] * 2
    assert_golden("health_tree", judged.at(140.0).reason, "no feedback", "distance_remaining", "/go", "0.5", "10 s")


def test_memory_is_bounded_for_any_number_of_goals():
    judged = world(**FALLS)
    for goal in range(16):
        drive(judged, (101 + goal / 10, 9.0), goal=goal)
    drive(judged, (103.0, 9.0), goal=0)
    assert judged.deadline(103.0) == 112.5, "16 goals are remembered"
    drive(judged, (104.0, 9.0), goal=16)
    drive(judged, (105.0, 9.0), goal=1)
    assert judged.deadline(105.0) == 115.0, "the one with the oldest feedback was forgotten"


def test_unreadable_feedback_is_no_progress():
    judged = world(**FALLS)
    drive(judged, (100.5, 9.0), (105.0, math.nan), (106.0, math.inf))
    assert_golden(
        "health_tree", judged.at(110.5).reason, "distance_remaining is inf", "distance_remaining", "/go", "0.5", "10 s"
    )
    judged.hear("/go/_action/feedback", 111.0, "not of that type").at(111.0)
    assert "(its value cannot be determined: not of that type)" in judged.at(111.0).reason
    judged.hear("/go/_action/feedback", 111.5, object()).at(111.5)
    assert_golden("health_tree", judged.at(111.5).reason, "not feedback")


def test_an_instance_that_takes_over_a_goal_has_the_startup_grace():
    judged = world(gap="1s", **FALLS)
    judged.since = START + 200.0
    assert judged.at(204.9) == Verdict("Starting", "no feedback of /go yet", "go.progress", None)
    assert judged.deadline(204.9) == 205.0
    assert judged.at(205.0).state == "Failed"
    assert drive(judged, (205.5, 8.0)) == ["Healthy"]
    assert judged.deadline(205.5) == 206.5


def test_a_clock_step_moves_remembered_times():
    judged = world(**FALLS)
    drive(judged, (100.5, 9.0), (103.0, 8.0))
    judged.task = 3700.0
    record = judged.records["/go/_action/feedback"]
    record.shift(3600.0)
    assert judged.states([3712.9, 3713.0]) == ["Healthy", "Failed"]


def test_inside_a_while_the_longer_settling_time_counts():
    tree = {"while": {"task_active": {"action": "/go"}}, "settle": "7s", "do": leaf(gap="1s", settle="3s")}
    judged = World(tree, grace=5.0)
    judged.task = 100.0
    assert judged.deadline(100.0) == 107.0, "the longer of both times to start"
    assert_golden("health_tree", judged.at(107.0).reason, "/go", "1 s")


def test_status_and_feedback_are_watched_and_the_leaf_is_left_out_without_one():
    tree = load(leaf(**FALLS))
    status, feedback = sorted(tree.topics, key=lambda topic: topic.name, reverse=True)
    assert (status.name, status.task) == ("/go/_action/status", True)
    assert (feedback.name, feedback.type, feedback.whole) == (
        "/go/_action/feedback",
        "t/action/Go_FeedbackMessage",
        True,
    )
    by_gap = next(topic for topic in load(leaf(gap="1s")).topics if not topic.task)
    assert (by_gap.type, by_gap.whole) == (None, False), "nothing of it is read"
    for name in (status.name, feedback.name):
        tree.leave_out({name})
        assert tree.root is None


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        ("/go", "", "found '/go'; 'progress' must be a mapping such as {action: /navigate_to_pose, gap: 5s}"),
        ({"gap": "1s"}, ".action", "missing; give the action's fully qualified name, such as /navigate_to_pose"),
        ({"action": "go", "gap": "1s"}, ".action", "found 'go'; did you mean '/go'?"),
        (
            {"action": "/go"},
            "",
            "none of gap, falls and grows is given; give gap, such as 5s, or falls, such as distance_remaining",
        ),
        ({"action": "/go", "gap": "1s", "type": "t/msg/Go"}, ".type", "found 't/msg/Go'; give package/action/Name"),
        (
            {"action": "/go", "gap": "1s", "by": 1},
            ".by",
            "it is only for falls or grows; give one of these, or remove it",
        ),
        (
            {"action": "/go", **FALLS, "grows": "x"},
            ".grows",
            "found falls and grows; give the one that shows progress",
        ),
        ({"action": "/go", **FALLS, "by": 0}, ".by", "found 0; give a number above 0, such as 0.2"),
        ({"action": "/go", **FALLS, "by": "much"}, ".by", "found 'much'; give a number above 0, such as 0.2"),
        ({"action": "/go", **FALLS, "by": True}, ".by", "found True; give a number above 0, such as 0.2"),
        (
            {"action": "/go", **FALLS, "falls": "distance"},
            ".falls",
            "found 'distance': t/action/Go_Feedback has no field 'distance', did you mean 'distance_remaining'?",
        ),
        (
            {"action": "/go", **FALLS, "falls": "distance_remaining > 1"},
            ".falls",
            "found 'distance_remaining > 1': distance_remaining > 1 is true or false, not a number; calculate with numbers",
        ),
        (
            {"action": "/go", **FALLS, "falls": 3},
            ".falls",
            "found 3; write a field of the feedback, such as distance_remaining",
        ),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    from tests.unit.trees.messages import fields

    with pytest.raises(TreeError) as caught:
        load({"progress": found}, fields=fields)
    assert [str(problem) for problem in caught.value.problems] == [f"{ROOT}.progress{place}: {expected}"]


def test_all_missing_keys_are_reported():
    with pytest.raises(TreeError) as caught:
        load({"progress": {"action": "/go", "falls": "x"}})
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        f"{ROOT}",
        "progress.type",
        "progress.by",
        "progress.within",
    )


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {"parallel": [leaf(**FALLS, settle="1s"), {**leaf(gap="20s"), "name": "talk"}]}
    text = written(
        '<Progress action="/go" type="t/action/Go" falls="distance_remaining" by="0.5" within="10s" settle="1s"/>'
        '<Progress name="talk" action="/go" gap="20s"/>'
    )

    def run(judged):
        judged.task = 100.0
        for time, distance in ((101, 9.0), (106, 8.0), (112, 7.8), (130, 1.0)):
            judged.feed_back(time, distance_remaining=distance)
            yield from (judged.at(time), judged.deadline(time), judged.at(time + 4.5))

    assert states_in_both_forms(text, short, run) == [
        *["Healthy"] * 5,
        *["Healthy", "Failed"],
        *["Healthy"] * 2,
    ]
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Progress action="/go" gap="1"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'1'",
    )


NODES = [
    leaf(gap="700ms", settle="300ms"),
    leaf(**{**FALLS, "within": "1s"}, settle="300ms"),
    leaf(gap="600ms", **{**FALLS, "within": "1500ms"}),
]


@settings(max_examples=150, deadline=None)
@given(
    node=st.sampled_from([*NODES, {"inverter": NODES[1]}, {"selector": NODES[:2]}]),
    fed=st.lists(st.tuples(st.integers(0, 600), st.integers(0, 8), st.integers(1, 2)), max_size=12),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, fed, task, since, now):
    """Times in hundredths of a second, distances in quarters of a metre."""
    assume(now >= since)
    nodes = node.get("selector", [])
    if nodes:
        node = {"selector": [{**one, "name": f"n{i}"} for i, one in enumerate(nodes)]}
    judged = World(node, grace=2.0, since=since / 100)
    for time, distance, goal in sorted(fed):
        if time <= now:
            judged.task = task / 100 if task is not None and task <= time else None
            judged.feed_back(time / 100, goal, distance_remaining=distance / 4).at(time / 100)
    judged.task = task / 100 if task is not None and task <= now else None
    assert_deadline_is_the_first_worse_moment(judged, now / 100)


@settings(max_examples=150, deadline=None)
@given(fed=st.lists(st.tuples(st.integers(1, 300), st.integers(0, 40)), min_size=1, max_size=30))
def test_the_leaf_is_healthy_exactly_while_the_best_distance_improves_in_time(fed):
    """Gaps in hundredths of a second, distances in quarters of a metre; ``within`` ends between the hundredths."""
    judged = world(**{**FALLS, "within": "3005ms"}, settle="10ms")
    time, bettered, best = 10_001, 10_000, None
    for gap, distance in fed:
        time += gap
        expected = time <= bettered + 300
        assert judged.at(time / 100).state == ("Healthy" if expected else "Failed")
        judged.feed_back(time / 100, distance_remaining=distance / 4)
        if best is None or distance <= best - 2:
            best, bettered = distance, time
        assert judged.at(time / 100).state == ("Healthy" if time <= bettered + 300 else "Failed")


@settings(max_examples=300, deadline=None)
@given(
    text=st.text(max_size=40)
    | st.lists(
        st.sampled_from(
            ["distance_remaining", "current_pose", ".", "name", "(", ")", "*", "/", "0", "2", "min", ",", "["]
        ),
        max_size=9,
    ).map("".join)
)
def test_any_quantity_is_refused_or_finite_or_undecided(text):
    try:
        quantity = Quantity.parse(text, "t/action/Go_Feedback")
    except ExpressionError:
        return
    with contextlib.suppress(Undefined):
        feedback = GoFeedback(
            distance_remaining=3.5, number_of_recoveries=1, current_pose=Pack(name="a", temperature=9.0)
        )
        assert math.isfinite(quantity.value(feedback))
