"""The leaf `log`: which messages count, when they are too many, and when all is well again."""

from __future__ import annotations

import re
import time as clock
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.messages import Log
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
from understudy.trees.languages.short.health_loader import TreeError

ERROR = Log(level=40, name="controller_server", msg="Failed to make progress")


def leaf(**more: Any) -> dict[str, Any]:
    return {"log": {"level": "ERROR", **more}}


def world(**more: Any) -> World:
    return World(leaf(**more), grace=5.0)


def say(world: World, time: float, **more: Any) -> World:
    entry = {"level": 40, "name": "controller_server", "msg": "Failed to make progress", **more}
    return world.hear("/rosout", time, Log(**entry))


def test_the_leaf_fails_with_a_message_and_recovers_after_the_quiet_time():
    judged = world(quiet="3s")
    assert judged.at(10.0) == Verdict("Healthy", "", "", None)
    assert judged.deadline(10.0) is None
    verdict = say(judged, 10.5).at(10.5)
    assert verdict == Verdict("Failed", verdict.reason, "log", START + 10.5)
    assert_golden(
        "health_tree", verdict.reason, "ERROR", "/rosout", "controller_server says ERROR: Failed to make progress"
    )
    assert say(judged, 12.0, msg="again").states([14.9, 15.0]) == ["Failed", "Healthy"]
    assert judged.deadline(15.0) is None
    assert say(judged, 16.0, msg="once\n more").at(16.0).reason.endswith("(controller_server says ERROR: once more)")


def test_control_characters_in_a_log_message_do_not_get_into_the_reason():
    """Any node of the robot may log them, and the reason is shown in terminals."""
    hostile = {"name": "amcl\x1b]0;owned\x07", "msg": "lost\x1b[2J\x9b31m\u202e"}
    reason = say(world(), 10.5, **hostile).at(10.5).reason
    assert reason.isprintable()
    assert r"amcl\x1b]0;owned\x07 says ERROR: lost\x1b[2J\x9b31m\u202e" in reason


def test_fewer_than_the_count_within_the_window_are_no_failure():
    judged = world(count=3, window="10s")
    for time in (10.0, 15.0, 20.0, 25.0, 30.0):
        assert say(judged, time).at(time).state == "Healthy", "the third is 10 s after the first"
    failed = say(judged, 34.9, msg="the last").at(34.9)
    verdict = failed
    assert verdict == Verdict("Failed", verdict.reason, "log", START + 25.0)
    assert_golden("health_tree", verdict.reason, "3 messages", "10 s", "/rosout", "controller_server")
    assert judged.states([44.8, 44.9]) == ["Failed", "Healthy"], "the window, where no other time is said"
    for time in (45.0, 46.0):
        assert say(judged, time).at(time).state == "Healthy", "counted anew"
    assert say(judged, 47.0).at(47.0).state == "Failed"


@pytest.mark.parametrize(
    ("pattern", "entry"),
    [
        ({"level": "ERROR"}, {"level": 30}),
        ({"level": "FATAL"}, {"level": 40}),
        ({"node": "/controller_server"}, {"name": "controller_server2"}),
        ({"node": "/controller_server"}, {"name": "robot.controller_server"}),
        ({"node": "/robot/controller_server"}, {}),
        ({"says": "Failed to stop"}, {}),
        ({"says": "progress*Failed"}, {}),
        ({"says": "failed"}, {}),
        ({"says": "Failed * * make"}, {}),
        ({"level": "ERROR", "node": "/planner_server", "says": "progress"}, {"file": "planner_server.cpp"}),
    ],
)
def test_other_messages_have_no_influence(pattern, entry):
    judged = World({"log": pattern}, grace=5.0)
    for time in range(10, 30):
        assert say(judged, time, **entry).at(time).state == "Healthy"


@pytest.mark.parametrize(
    ("pattern", "entry"),
    [
        ({"level": "ERROR"}, {"level": 50}),
        ({"level": "DEBUG"}, {}),
        ({"node": "/controller_server"}, {"level": 10}),
        ({"node": "/controller_server"}, {"name": "controller_server.FollowPath"}),
        ({"node": "/robot/controller_server"}, {"name": "robot.controller_server"}),
        ({"says": "make progress"}, {}),
        ({"says": "*Failed*to*progress*"}, {}),
        ({"says": "Failed to * progress"}, {}),
        ({"level": "WARN", "node": "/controller_server", "says": "progress"}, {}),
    ],
)
def test_matching_messages_fail(pattern, entry):
    judged = World({"log": pattern}, grace=5.0)
    assert say(judged, 10.0, **entry).at(10.0).state == "Failed"


def test_the_reason_names_all_parts_of_the_pattern():
    judged = World({"log": {"level": "FATAL", "node": "/a", "says": "out of * memory"}}, grace=5.0)
    assert_golden(
        "health_tree",
        say(judged, 10.0, level=50, name="a", msg="out of all memory " + 200 * "x").at(10.0).reason,
        "FATAL by node /a",
        "(a says FATAL: out of all memory " + 14 * "x",
        "x...)",
    )
    assert_golden("health_tree", judged.tree.root.reason("Healthy"), "/a", "/rosout")


def test_messages_during_the_start_fail_the_instance_only_if_they_continue():
    judged = say(world(quiet="3s"), 1.0)
    assert_golden("health_tree", judged.at(1.0).reason, "/rosout", "controller_server")
    assert judged.states([3.9, 4.0, 6.0]) == ["Starting", "Healthy", "Healthy"]
    say(judged, 4.5)
    assert judged.deadline(4.5) == 5.0
    assert judged.states([4.9, 5.0]) == ["Starting", "Failed"]


def test_log_messages_of_the_previous_instance_do_not_count_for_the_next():
    judged = say(say(world(count=2, window="60s"), 10.0), 11.0)
    assert judged.at(11.0).state == "Failed"
    judged.since = START + 12.0
    assert judged.at(18.0).state == "Healthy"
    assert say(judged, 19.0).at(19.0).state == "Healthy", "the first of its own"


def test_a_clock_step_moves_remembered_times():
    judged = say(say(world(count=2, window="10s", quiet="10s"), 10.0), 11.0)
    judged.at(11.0)
    for content in judged.records["/rosout"].contents:
        content.received += 3600.0
    assert judged.states([3620.9, 3621.0]) == ["Failed", "Healthy"]


def test_for_a_task_only_messages_during_the_task_count():
    judged = World({**TASK, "do": leaf(count=2, window="60s")}, grace=5.0)
    for time in (90.0, 91.0, 99.0):
        assert say(judged, time).at(time).state == "Healthy"
    judged.task = 100.0
    assert say(judged, 100.2).at(100.2).state == "Healthy"
    assert say(judged, 100.5).at(100.5).state == "Healthy", "it may start for a second"
    assert judged.deadline(100.5) == 101.0
    assert judged.at(101.0).reason.endswith("progress) while a goal of /go is active")
    judged.task = None
    assert judged.at(102.0).state == "Healthy"
    judged.task = 103.0
    assert judged.at(105.0).state == "Healthy", "another goal, counted anew"


def test_a_message_that_cannot_be_read_is_ignored():
    judged = world().hear("/rosout", 10.0, "not a log").hear("/rosout", 10.1, object())
    assert judged.at(10.1).state == "Healthy"


def test_a_malicious_text_does_not_slow_down_a_pattern():
    judged = World({"log": {"says": "*".join(["a" * 8] * 20) + "*b"}}, grace=5.0)
    started_at = clock.process_time()
    for time in range(20):
        say(judged, 10.0 + time, msg="a" * 200_000)
    assert judged.at(30.0).state == "Healthy"
    assert clock.process_time() - started_at < 5.0, "a backtracking search would not be back in our time"


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        ("x", "", "found 'x'; 'log' must be a mapping such as {level: ERROR, node: /controller_server}"),
        (
            {},
            "",
            "none of level, node and says is given; say which messages count, such as "
            "{level: ERROR, node: /controller_server}",
        ),
        ({"level": "error"}, ".level", "found 'error', did you mean 'ERROR'?"),
        ({"level": 40}, ".level", "found 40; known are DEBUG, INFO, WARN, ERROR, FATAL"),
        ({"node": "a"}, ".node", "found 'a'; did you mean '/a'?"),
        (
            {"says": "**"},
            ".says",
            "found '**'; give text of up to 256 characters that is in the message, such as 'Failed to make progress', "
            "where * stands for any characters",
        ),
        ({"level": "ERROR", "count": 0, "window": "1s"}, ".count", "found 0; give a whole number from 1 to 1000"),
        ({"level": "ERROR", "count": 3}, ".window", "missing; give the time within which 3 messages are too many"),
        (
            {"level": "ERROR", "window": "3s"},
            ".window",
            "a window is only for a count above 1; give count, or remove window",
        ),
        (
            {"level": "ERROR", "quiet": 3},
            ".quiet",
            "found 3, which has no unit; write it with ms, s, m or h, such as 500ms",
        ),
        (
            {"level": "ERROR", "for": "3s"},
            ".for",
            "unknown key 'for'; known are level, node, says, count, window, quiet",
        ),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("log", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    short = {
        "parallel": [
            {"log": {"level": "ERROR", "node": "/controller_server", "count": 2, "window": "5s", "quiet": "2s"}},
            {"name": "progress", "log": {"says": "to * progress"}},
        ]
    }
    text = written(
        '<Log level="ERROR" node="/controller_server" count="2" window="5s" quiet="2s"/>'
        '<Log name="progress" says="to * progress"/>'
    )

    def drive(judged):
        for time, text in ((36, "a"), (37, "b"), (50, "Failed to make progress"), (70, "a")):
            say(judged, time, msg=text)
            yield from (judged.at(time), judged.deadline(time), judged.at(time + 2.5))

    assert states_in_both_forms(text, short, drive) == [
        "Healthy",
        *["Healthy"] * 2,
        *["Failed", "Healthy"],
        *["Failed"] * 2,
        *["Healthy"] * 2,
    ]
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Log level="BAD"/>'))
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'BAD'",
    )


@settings(max_examples=150, deadline=None)
@given(
    node=st.sampled_from(
        [leaf(quiet="700ms"), leaf(count=2, window="1s"), {"inverter": leaf(count=2, window="1s", quiet="400ms")}]
    ),
    entries=st.lists(st.tuples(st.integers(0, 600), st.sampled_from([20, 40])), max_size=12),
    tasked=st.booleans(),
    task=st.none() | st.integers(0, 600),
    since=st.integers(0, 300),
    now=st.integers(0, 600),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, entries, tasked, task, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    judged = World({**TASK, "do": node} if tasked else node, grace=2.0, since=since / 100)
    for time, level in sorted(entries):
        if time <= now:
            judged.task = task / 100 if task is not None and task <= time else None
            say(judged, time / 100, level=level).at(time / 100)
    judged.task = task / 100 if task is not None and task <= now else None
    assert_deadline_is_the_first_worse_moment(judged, now / 100)


@settings(max_examples=150, deadline=None)
@given(
    entries=st.lists(st.integers(600, 3000), max_size=40),
    count=st.integers(2, 4),
    window=st.integers(1, 300),
    quiet=st.integers(1, 300),
    looks=st.lists(st.integers(600, 3300), max_size=10),
)
def test_window_and_quiet_time_do_not_depend_on_how_often_the_tree_is_evaluated(entries, count, window, quiet, looks):
    """Times in hundredths of a second; window and quiet end between them, where floats don't decide."""
    judged = world(count=count, window=f"{window * 10 + 5}ms", quiet=f"{quiet * 10 + 5}ms")
    counted: list[int] = []
    bad = False
    for time, looked in sorted([(time, False) for time in entries] + [(time, True) for time in looks]):
        if bad and time > counted[-1] + quiet:
            bad, counted = False, []
        if looked:
            assert judged.at(time / 100).state == ("Failed" if bad else "Healthy")
        else:
            say(judged, time / 100)
            counted = [*counted, time][-count:]
            bad = bad or (len(counted) == count and counted[-1] - counted[0] <= window)


@settings(deadline=None)
@given(
    says=st.text("ab* ", min_size=1, max_size=8).filter(lambda text: text.strip("* ")),
    text=st.text("ab \n", max_size=20),
)
def test_a_pattern_matches_like_the_equivalent_regular_expression(says, text):
    expected = re.search(".*".join(map(re.escape, says.split("*"))), text, re.DOTALL)
    judged = World({"log": {"says": says}}, grace=5.0)
    assert say(judged, 10.0, msg=text).at(10.0).state == ("Failed" if expected else "Healthy")
