"""Leaves that look into messages: what they say, when, and that their deadlines are exact."""

import math
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.unit.trees.messages import Battery, Heard, fields
from tests.unit.trees.world import START, World, states_in_both_forms, written
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.languages.btcpp.loader import load_xml
from understudy.trees.languages.short.health_loader import TreeError, load
from understudy.trees.leaves.registry import LEAVES


def value(holds: str = "percentage > 0.15", **more: Any) -> dict[str, Any]:
    return {"value": {"topic": "/battery", "type": "t/msg/Battery", "holds": holds, **more}}


def age(most: str = "300ms", **more: Any) -> dict[str, Any]:
    return {"age": {"topic": "/scan", "most": most, **more}}


def levels(**more: Any) -> dict[str, Any]:
    return {"diagnostics": {"worst": "WARN", **more}}


class Status:
    def __init__(self, name: str, level: int, message: str = "") -> None:
        self.name, self.level, self.message = name, bytes([level]), message


class Array:
    def __init__(self, *status: Status) -> None:
        self.status = status


# -- value ------------------------------------------------------------------------------------------------------------


def test_a_value_fails_by_the_message_that_says_so_and_is_well_again_by_the_next():
    world = World(value()).battery(1.0, 0.5)
    assert world.at(1.1).state == "Healthy"
    assert world.deadline(1.1) is None, "silence says nothing of a value"
    assert world.battery(2.0, 0.1).at(2.0) == Verdict(
        "Failed", "percentage > 0.15 of /battery does not hold (percentage was 0.1)", "battery.value", START + 1.0
    )
    assert world.battery(3.0, 0.2).at(3.0) == Verdict("Healthy", "", "", None)


def test_a_value_fails_exactly_when_it_has_not_held_for_so_long():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    assert world.at(1.1).state == "Healthy"
    assert world.battery(2.0, 0.1).at(2.1).state == "Healthy"
    assert world.deadline(2.1) == 2.5
    assert world.battery(2.3, 0.05).at(2.49999).state == "Healthy"
    assert world.deadline(2.49) == 2.5, "the first of them counts"
    assert world.at(2.5) == Verdict(
        "Failed",
        "percentage > 0.15 of /battery has not held for 500 ms (percentage was 0.1)",
        "battery.value",
        START + 1.0,
    )


def test_a_value_that_was_true_in_between_starts_its_time_again():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    world.at(1.0)
    world.battery(1.3, 0.1).at(1.3)
    world.battery(1.7, 0.5).at(1.7)
    world.battery(1.75, 0.1).at(1.75)
    assert world.at(2.2).state == "Healthy"
    assert world.deadline(2.2) == 2.25


def test_with_recovers_one_that_has_failed_holds_only_when_that_does():
    world = World(value(recovers="percentage > 0.3", **{"for": "1s"})).battery(1.0, 0.2)
    assert world.at(1.1).state == "Healthy"
    assert world.battery(2.0, 0.1).at(2.0).state == "Healthy"
    assert world.battery(2.9, 0.2).at(3.5).state == "Healthy", "it had not failed yet"
    assert world.battery(4.0, 0.1).at(5.0).state == "Failed"
    assert world.battery(5.5, 0.25).at(6.0).state == "Failed"
    assert world.battery(6.5, 0.31).at(6.5).state == "Healthy"
    assert world.battery(7.0, 0.2).at(9.0).state == "Healthy"


def test_before_it_has_held_once_it_is_starting_until_the_grace_is_over():
    world = World(value(recovers="percentage > 0.9"), grace=10)
    assert world.at(1.0).reason == "waiting for the first /battery, for up to 10 s"
    assert world.deadline(1.0) == 10
    world.battery(2.0, 0.1)
    assert world.at(9.999) == Verdict(
        "Starting", "percentage > 0.15 of /battery has not held yet (percentage was 0.1)", "battery.value", None
    )
    assert world.deadline(9.0) == 10
    assert world.at(10.0) == Verdict(
        "Failed",
        "percentage > 0.15 of /battery has not held within 10 s of the start (percentage was 0.1)",
        "battery.value",
        None,
    )
    assert world.battery(11.0, 0.5).at(11.0).state == "Healthy", "recovers is for what has held before"
    assert World(value(), grace=10).at(10).reason == "no /battery within 10 s of the start"


def test_an_undecided_value_does_not_hold():
    world = World(value("cells[0] > 1")).hear("/battery", 1.0, Battery(cells=[2.0]))
    assert world.at(1.0).state == "Healthy"
    world.hear("/battery", 2.0, Battery(cells=[]))
    assert world.at(2.0).reason == (
        "cells[0] > 1 of /battery does not hold (it cannot be determined: cells has 0 elements, and so no cells[0])"
    )
    world.hear("/battery", 3.0, Battery(cells=[2.0])).at(3.0)
    world.hear("/battery", 4.0, "it is no Battery")
    assert world.at(4.0).reason == "cells[0] > 1 of /battery does not hold (it cannot be determined: it is no Battery)"


def test_each_message_is_read_once_and_only_where_it_is_the_newest_at_a_look():
    world = World({"parallel": [value(), {**value("percentage < 0.9"), "name": "full"}]}).battery(1.0, 0.5)
    reads = []

    class Counted(Heard):
        def message(self) -> object:
            reads.append(self.received - START)
            return Battery(percentage=0.5)

    for time in (2.0, 3.0, 4.0):
        world.records["/battery"].contents.append(Counted(START + time))
    for now in (4.1, 4.2, 4.3):
        assert world.at(now).state == "Healthy"
        world.deadline(now)
    assert reads == [4.0, 4.0], "once by each of the two leaves"


def test_the_next_instance_is_judged_by_its_own_messages():
    world = World(value(**{"for": "500ms"}), grace=10).battery(1.0, 0.5)
    assert world.at(1.0).state == "Healthy"
    assert world.battery(2.0, 0.1).at(3.0).state == "Failed"
    world.since = START + 3.5
    assert world.at(3.6).reason == "waiting for the first /battery, for up to 10 s"
    assert world.battery(4.0, 0.5).at(4.0).state == "Healthy"


def test_a_clock_step_moves_remembered_times():
    world = World(value(**{"for": "500ms"})).battery(1.0, 0.5)
    world.at(1.0)
    world.battery(2.0, 0.1).at(2.1)
    world.records["/battery"].shift(3600.0)
    assert world.at(3602.4).state == "Healthy"
    assert world.deadline(3602.4) == 3602.5
    assert world.at(3602.5).onset == START + 3601.0


def test_a_tree_that_is_new_to_an_old_instance_gives_it_the_grace():
    world = World({"parallel": [value(), {"topic": {"name": "/scan", "gap": "1s"}}]}, grace=10)
    assert world.at(100.0).state == "Failed"
    world.tree.begin(START + 100.0)
    assert world.at(100.0).state == "Starting"
    assert world.deadline(100.0) == 110
    assert world.battery(101.0, 0.5).hear("/scan", 109.5).at(110.0).state == "Healthy"


def test_a_topic_that_cannot_be_watched_is_left_out():
    world = World({"parallel": [value(), age(), levels()]}, grace=0).hear("/scan", 1.0, late=0.1)
    world.tree.leave_out({"/battery", "/diagnostics"})
    assert world.at(1.0).state == "Healthy"


def test_an_inverter_over_a_value():
    world = World({"inverter": value("charging")}).hear("/battery", 1.0, Battery(charging=True))
    assert world.at(1.0).reason == "charging of /battery holds, which must not be"


# -- for a task -------------------------------------------------------------------------------------------------------


def during(node: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"while": {"task_active": {"action": "/go"}}, "do": node, **more}


def test_while_no_task_is_active_a_value_is_not_judged():
    world = World(during(value(**{"for": "500ms"})), grace=5).battery(100.0, 0.1)
    assert world.at(110.0).state == "Healthy"
    assert world.deadline(110.0) is None
    world.task = 120.0
    assert world.at(120.1).state == "Healthy"
    assert world.deadline(120.1) == 122, "its clocks begin with the task, which may settle"
    assert world.at(122.0).reason == (
        "percentage > 0.15 of /battery has not held for 500 ms (percentage was 0.1) while a goal of /go is active"
    )
    assert world.at(122.0).onset == START + 120.0
    world.task = None
    assert world.at(123.0).state == "Healthy"


def test_after_it_has_settled_a_value_of_a_task_fails_as_any_other():
    world = World(during(value(**{"for": "500ms"}), settle="1s"), grace=5).battery(100.0, 0.5)
    world.task = 100.0
    assert world.at(100.0).state == "Healthy"
    assert world.battery(110.0, 0.1).at(110.1).state == "Healthy"
    assert world.deadline(110.1) == 110.5


def test_an_instance_that_takes_over_an_active_task_has_the_grace_of_a_start():
    world = World(during(value(), settle="1s"), grace=10, since=200).battery(199.9, 0.5)
    world.task = 100.0
    assert world.at(205).state == "Starting"
    assert world.deadline(205) == 210
    assert world.at(210).reason == "no /battery while a goal of /go is active"
    assert world.battery(206, 0.1).at(206).state == "Starting"
    assert world.battery(207, 0.5).at(207).state == "Healthy"
    assert world.battery(208, 0.1).at(208).state == "Failed"


# -- age --------------------------------------------------------------------------------------------------------------


def test_an_age_is_that_of_the_newest_message_when_it_was_received():
    world = World(age()).hear("/scan", 1.0, late=0.3)
    assert world.at(9.0).state == "Healthy", "how long ago it was received is for a gap"
    assert world.hear("/scan", 10.0, late=0.4123).at(10.0) == Verdict(
        "Failed", "an age of at most 300 ms of /scan does not hold (it was 412 ms)", "scan.age", START + 1.0
    )
    assert world.hear("/scan", 11.0, late=-2.0).at(11.0).state == "Healthy"
    assert world.hear("/scan", 12.0, late=None).at(12.0).reason.endswith("(it cannot be determined: there is no stamp)")


def test_a_single_late_message_is_no_failure_where_it_must_last():
    world = World(age(**{"for": "1s"})).hear("/scan", 1.0, late=0.1)
    world.at(1.0)
    assert world.hear("/scan", 2.0, late=0.5).at(2.0).state == "Healthy"
    assert world.deadline(2.0) == 3
    assert world.hear("/scan", 2.5, late=0.1).at(3.5).state == "Healthy"
    world.hear("/scan", 4.0, late=2.5).at(4.0)
    assert world.at(5.0).reason == "an age of at most 300 ms of /scan has not held for 1 s (it was 2.5 s)"


def test_an_age_by_its_source_is_that_since_it_was_sent_whatever_its_stamp_says():
    world = World(age(by="source")).hear("/scan", 1.0, late=9.0, way=0.3)
    assert world.at(9.0).state == "Healthy"
    assert world.hear("/scan", 10.0, late=0.0, way=0.4123).at(10.0) == Verdict(
        "Failed",
        "an age of at most 300 ms of /scan since it was sent does not hold (it was 412 ms)",
        "scan.age",
        START + 1.0,
    )
    assert world.hear("/scan", 11.0, way=-2.0).at(11.0).state == "Healthy", "a clock that is ahead"
    assert (
        world.hear("/scan", 12.0, late=0.0)
        .at(12.0)
        .reason.endswith("(it cannot be determined: the middleware did not report when it was sent)")
    )


def test_an_age_by_its_source_needs_no_header():
    load({"age": {"topic": "/p", "type": "t/msg/Pack", "most": "1s", "by": "source"}}, fields=fields)


def test_an_age_is_the_same_in_all_languages():
    short = {"parallel": [age(by="source", **{"for": "1s"}), {**age(by="stamp"), "name": "stamped"}]}
    text = written(
        '<Age topic="/scan" most="300ms" for="1s" by="source"/><Age name="stamped" topic="/scan" most="300ms" by="stamp"/>'
    )

    def drive(world):
        for time, late, way in ((1, 0.1, 0.1), (2, 0.1, 0.5), (3.5, 0.1, 0.5), (4, 0.4, 0.2), (5, 0.2, 0.2)):
            world.hear("/scan", time, late=late, way=way)
            yield from (world.at(time), world.deadline(time))

    assert states_in_both_forms(text, short, drive) == ["Starting", "Healthy", "Healthy", "Failed", "Failed", "Healthy"]


@settings(max_examples=100, deadline=None)
@given(
    ways=st.lists(st.tuples(st.integers(0, 600), st.sampled_from([0.0, 0.2, 0.4, None])), max_size=12),
    hold_off=st.sampled_from([None, "700ms"]),
    now=st.integers(0, 600),
)
def test_by_its_source_the_deadline_of_an_age_is_the_first_moment_that_is_worse(ways, hold_off, now):
    """Times in hundredths of a second."""
    world = World(age(by="source", **({"for": hold_off} if hold_off else {})), grace=2.0)
    for time, way in sorted(ways, key=lambda one: one[0]):
        if time <= now:
            world.hear("/scan", time / 100, way=way).at(time / 100)
    present = SEVERITY[world.at(now / 100).state]
    deadline = world.deadline(now / 100)
    worse = next((now + step for step in range(1, 400) if SEVERITY[world.at((now + step) / 100).state] > present), None)
    assert (deadline is None) == (worse is None)
    assert deadline is None or math.isclose(worse / 100, deadline, abs_tol=0.011)


# -- diagnostics ------------------------------------------------------------------------------------------------------


def test_the_level_of_a_status_is_the_last_that_was_said_of_it_however_many_others_speak():
    world = World(levels(name="camera: driver"), grace=10)
    world.hear("/diagnostics", 1.0, Array(Status("lidar", 2, "dead")))
    assert world.at(1.0).reason == "waiting for the first status 'camera: driver' on /diagnostics, for up to 10 s"
    world.hear("/diagnostics", 2.0, Array(Status("lidar", 2), Status("camera: driver", 1)))
    assert world.at(2.0).state == "Healthy"
    world.hear("/diagnostics", 3.0, Array(Status("camera: driver", 2, "no\nframes")))
    world.hear("/diagnostics", 3.1, Array(Status("lidar", 0)))
    assert world.at(3.2) == Verdict(
        "Failed",
        "a level of at most WARN of status 'camera: driver' on /diagnostics does not hold "
        "(camera: driver says ERROR: no frames)",
        "diagnostics",
        START + 2.0,
    )
    world.hear("/diagnostics", 4.0, Array(Status("camera: driver", 0)))
    assert world.at(4.0).state == "Healthy"


def test_the_worst_level_of_a_prefix_counts():
    world = World(levels(prefix="camera", **{"for": "1s"}))
    world.hear("/diagnostics", 1.0, Array(Status("camera a", 0), Status("camera b", 0))).at(1.0)
    world.hear("/diagnostics", 2.0, Array(Status("camera b", 3, "gone")))
    world.hear("/diagnostics", 2.1, Array(Status("camera a", 2, "hot"))).at(2.2)
    assert world.deadline(2.2) == 3
    assert world.at(3.0).reason.endswith("has not held for 1 s (camera b says STALE: gone)")
    world.hear("/diagnostics", 3.1, Array(Status("camera b", 0)))
    assert world.at(3.2).state == "Failed"
    world.hear("/diagnostics", 3.3, Array(Status("camera a", 0)))
    assert world.at(3.4).state == "Healthy"


def test_without_a_name_every_status_counts_and_the_next_instance_starts_without_levels():
    world = (
        World(levels(worst="OK"), grace=10)
        .hear("/diagnostics", 1.0, Array(Status("a", 0)))
        .hear("/diagnostics", 1.1, Array(Status("b", 1), Status("c", 200)))
    )
    assert world.at(1.2).state == "Starting"
    assert "(c says level 200, and 1 more)" in world.at(10).reason
    world.since = START + 20
    world.hear("/diagnostics", 21.0, Array(Status("a", 0)))
    assert world.at(21).state == "Healthy"


def test_diagnostics_of_understudy_itself_are_ignored():
    for more in ({}, {"prefix": "u"}, {"topic": "/diagnostics_agg"}):
        world = World(levels(**more), grace=10)
        topic = more.get("topic", "/diagnostics")
        world.hear(
            topic, 1.0, Array(Status("understudy: robot-1-drive", 2), Status("/Other/understudy: robot-1-drive", 2))
        )
        assert world.at(1.0).reason.startswith("waiting for the first status")
        world.hear(topic, 2.0, Array(Status("understudy: robot-1-drive", 2), Status("usb", 0)))
        assert world.at(2.0).state == "Healthy"
        world.hear(topic, 3.0, Array(Status("understudy: robot-1-drive", 3)))
        assert world.at(3.0).state == "Healthy"


@pytest.mark.parametrize("key", ["name", "prefix"])
@pytest.mark.parametrize("text", ["understudy:", "understudy: robot-1-drive"])
def test_diagnostics_of_understudy_itself_cannot_be_selected(key, text):
    with pytest.raises(
        TreeError, match=rf"\.{key}: found '{text}': Understudy's own status is no evidence; give a status of"
    ):
        load(levels(**{key: text}))


def test_statuses_without_end_do_not_fill_the_memory_and_what_is_no_diagnostics_is_said():
    world = World(levels(prefix="n"))
    for step in range(40):
        world.hear("/diagnostics", step / 10, Array(*(Status(f"n{step}-{i}", 0) for i in range(50)))).at(step / 10)
    (leaf,) = world.tree.root.iterate()
    assert len(leaf._levels) == 512
    assert (
        world.hear("/diagnostics", 5.0, Battery())
        .at(5.0)
        .reason.endswith("(it cannot be determined: found a Battery, not a diagnostic_msgs/msg/DiagnosticArray)")
    )


# -- loading ----------------------------------------------------------------------------------------------------------

ROOT = "spec.monitoring.yaml"


def test_what_the_leaves_need_of_their_topics():
    tree = load(
        {
            "parallel": [
                value(),
                age(),
                levels(name="x"),
                {"topic": {"name": "/battery", "rate": "> 1 Hz"}},
                {**levels(topic="/diagnostics_agg", prefix="/Camera"), "name": "camera"},
            ]
        }
    )
    found = {topic.name: topic for topic in tree.topics}
    battery, scan, diagnostics = found["/battery"], found["/scan"], found["/diagnostics"]
    assert (battery.type, battery.contents, battery.whole, battery.rate) == ("t/msg/Battery", 1, True, 2.0)
    assert (scan.type, scan.contents, scan.whole) == (None, 1, False)
    assert (diagnostics.type, diagnostics.contents) == ("diagnostic_msgs/msg/DiagnosticArray", 64)
    leaves = [node.name for node in tree.root.iterate() if not node.children]
    assert leaves == ["battery.value", "scan.age", "diagnostics", "battery", "camera"]


@pytest.mark.parametrize(
    ("tree", "place", "expected"),
    [
        (
            {"value": "percentage > 1"},
            ".value",
            "found 'percentage > 1'; value is a mapping such as {topic: /battery_state, type: "
            'sensor_msgs/msg/BatteryState, holds: "percentage > 0.15"}',
        ),
        (
            {"value": {"topic": "/b", "holds": "percentage > 1"}},
            ".value.type",
            "missing; give the messages' type, such as sensor_msgs/msg/BatteryState",
        ),
        (
            {"value": {"topic": "/b", "type": "t/msg/Battery"}},
            ".value.holds",
            "missing; give the condition that must hold, such as 'percentage > 0.15'",
        ),
        (
            {"value": {"type": "t/msg/Battery", "holds": "charging"}},
            ".value.topic",
            "missing; give the topic's fully qualified name, such as /battery_state",
        ),
        (value(**{"For": "1s"}), ".value.For", "unknown key 'For', did you mean 'for'?"),
        (value(**{"for": 2}), ".value.for", "found 2, which has no unit; write it with ms, s, m or h, such as 500ms"),
        (value(True), ".value.holds", "found True; write a condition in quotes, such as 'percentage > 0.15'"),
        (
            value("percent > 1"),
            ".value.holds",
            "found 'percent > 1': t/msg/Battery has no field 'percent', did you mean 'percentage'?",
        ),
        (
            value(recovers="percentage"),
            ".value.recovers",
            "found 'percentage': percentage is a number, not true or false; compare it with something",
        ),
        ({**value(), "holds": "x"}, ".holds", "unknown key; holds belongs inside value"),
        (
            {"age": {"topic": "/scan"}},
            ".age.most",
            "missing; give how old a message may be when it arrives, such as 300ms",
        ),
        ({"age": {"topic": "scan", "most": "1s"}}, ".age.topic", "found 'scan'; did you mean '/scan'?"),
        (age(by="sent"), ".age.by", "found 'sent'; known are stamp, source"),
        (age(by="sourc"), ".age.by", "found 'sourc', did you mean 'source'?"),
        (age(by=1), ".age.by", "found 1; known are stamp, source"),
        (
            {"age": {"topic": "/p", "type": "t/msg/Pack", "most": "1s"}},
            ".age.type",
            "found t/msg/Pack, which does not begin with a header; an age needs one with a stamp, or give by: source",
        ),
        (
            {"diagnostics": {"name": "x"}},
            ".diagnostics.worst",
            "missing; give the worst level that is allowed: OK, WARN or ERROR",
        ),
        (levels(worst="warn"), ".diagnostics.worst", "found 'warn', did you mean 'WARN'?"),
        (levels(worst=1), ".diagnostics.worst", "found 1; known are OK, WARN, ERROR"),
        (
            levels(name="a", prefix="b"),
            ".diagnostics.prefix",
            "found name and prefix; give the whole name, or what the names begin with",
        ),
        (
            levels(name=""),
            ".diagnostics.name",
            "found ''; give text of up to 256 characters, such as 'camera: driver'",
        ),
        (
            {"parallel": [value(), value("charging")]},
            ".parallel[1].value",
            f"'battery.value' is already the name of {ROOT}.parallel[0].value; give one of them another name",
        ),
        (
            {"parallel": [value(), {"topic": {"name": "/battery", "type": "t/msg/Pack", "gap": "1s"}}]},
            ".parallel[1].topic.type",
            f"found t/msg/Pack, but {ROOT}.parallel[0].value.type says t/msg/Battery of the same topic /battery",
        ),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(tree, place, expected):
    with pytest.raises(TreeError) as caught:
        load(tree, fields=fields)
    assert [str(problem) for problem in caught.value.problems] == [f"{ROOT}{place}: {expected}"]


def test_fields_of_a_type_that_is_not_known_here_are_not_checked():
    tree = {"value": {"topic": "/b", "type": "my_msgs/msg/Own", "holds": "anything.at[3] > 1"}}
    for known in (fields, None):
        (topic,) = load(tree, fields=known).topics
        assert topic.whole


# -- the deadline -----------------------------------------------------------------------------------------------------

NODES = st.sampled_from(
    [
        value(),
        value(**{"for": "1s"}),
        value(**{"for": "400ms"}, recovers="percentage > 0.5"),
        {"selector": [value(**{"for": "1s"}), {**value("percentage > 0.05", **{"for": "300ms"}), "name": "low"}]},
        {"sequence": [value(**{"for": "1s"}), {"topic": {"name": "/battery", "gap": "2s"}}]},
        {"inverter": value(**{"for": "700ms"})},
    ]
)


@settings(max_examples=300, deadline=None)
@given(
    node=NODES,
    messages=st.lists(st.tuples(st.integers(0, 1200), st.sampled_from([0.01, 0.1, 0.2, 0.6, math.nan])), max_size=12),
    task=st.none() | st.integers(0, 1200),
    tasked=st.booleans(),
    since=st.integers(0, 600),
    now=st.integers(0, 1200),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(node, messages, task, tasked, since, now):
    """Times in hundredths of a second."""
    assume(now >= since)
    world = World(during(node, settle="1s") if tasked else node, grace=2.0, since=since / 100)
    world.task = task / 100 if task is not None and task <= now else None
    for time, percentage in sorted(messages, key=lambda message: message[0]):
        if time <= now:
            world.battery(time / 100, percentage).at(time / 100)
    present = SEVERITY[world.at(now / 100).state]
    deadline = world.deadline(now / 100)
    assert SEVERITY[world.at(now / 100).state] == present
    later = [now / 100 + step / 100 for step in range(1, 800)]
    worse = next((time for time in later if SEVERITY[world.at(time).state] > present), None)
    if deadline is None:
        assert worse is None
    else:
        assert worse == pytest.approx(deadline, abs=0.011)
        assert SEVERITY[world.at(math.nextafter(START + deadline, 0) - START).state] >= 0
        assert SEVERITY[world.at(deadline + 1e-5).state] > present
        assert SEVERITY[world.at(deadline - 1e-5).state] <= present


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["/b", "1s", "OK"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=4) | st.integers(), inner, max_size=3)
        | st.dictionaries(st.sampled_from(sorted({key for kind in LEAVES.values() for key in kind.keys})), inner)
    ),
    max_leaves=8,
)


@settings(max_examples=300, deadline=None)
@given(kind=st.sampled_from(sorted(LEAVES)), found=ANYTHING, beside=ANYTHING)
def test_whatever_a_leaf_is_given_it_loads_or_says_what_is_wrong(kind, found, beside):
    try:
        tree = load({kind: found, **(beside if isinstance(beside, dict) else {})}, fields=fields)
    except TreeError as error:
        assert all(problem.path.startswith(ROOT) and problem.message for problem in error.problems)  # noqa: PT017
    else:
        assert tree.topics


def test_the_leaves_in_xml_are_those_of_the_short_form():
    text = written(
        '<Value topic="/battery" type="t/msg/Battery" holds="0.15 &lt; percentage" recovers="percentage &gt; 0.5" for="1s"/>'
        '<Age topic="/scan" most="300ms"/><Diagnostics name="camera" status="camera: driver" worst="WARN"/>'
    )
    short = [
        value("0.15 < percentage", recovers="percentage > 0.5", **{"for": "1s"}),
        age(),
        {**levels(name="camera: driver"), "name": "camera"},
    ]
    read, same = load_xml(text, fields=fields), load({"parallel": short}, fields=fields)
    assert read.topics == same.topics
    trace = []
    for tree in (read, same):
        world = World({"parallel": short}, grace=5)
        world.tree = tree
        world.hear("/scan", 1.0, late=0.1).hear("/diagnostics", 1.0, Array(Status("camera: driver", 0)))
        found = [world.battery(time, percentage).at(time + 0.1) for time, percentage in enumerate((0.2, 0.1, 0.3, 0.6))]
        found.append(world.hear("/diagnostics", 6.0, Array(Status("camera: driver", 2))).at(6.0))
        trace.append(found)
    assert trace[0] == trace[1]
    assert [verdict.state for verdict in trace[0]][-3:] == ["Failed", "Healthy", "Failed"]


def test_a_condition_that_is_wrong_in_xml_is_named_by_its_line():
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Value topic="/battery" type="t/msg/Battery" holds="percent > 1"/>'), fields=fields)
    assert [str(problem) for problem in caught.value.problems] == [
        "spec.monitoring.xml, line 2, column 1: <Value> holds: found 'percent > 1': t/msg/Battery has no field "
        "'percent', did you mean 'percentage'?"
    ]
