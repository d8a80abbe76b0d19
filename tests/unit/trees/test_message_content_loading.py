"""Loading of leaves about message content, and their deadlines."""

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.content_messages import Array, Status, age, during, levels, value
from tests.unit.trees.messages import fields
from tests.unit.trees.world import ROOT, START, World, written
from understudy.trees.core.health_tree import SEVERITY
from understudy.trees.languages.short.health_loader import TreeError, load
from understudy.trees.leaves.registry import LEAVES

# -- loading ----------------------------------------------------------------------------------------------------------


def test_the_leaves_subscribe_to_what_they_need():
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
            "found 'percentage > 1'; 'value' must be a mapping such as {topic: /battery_state, type: "
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


def test_fields_of_a_type_that_is_not_installed_are_not_checked():
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
def test_any_input_of_a_leaf_loads_or_is_refused_with_a_message(kind, found, beside):
    try:
        tree = load({kind: found, **(beside if isinstance(beside, dict) else {})}, fields=fields)
    except TreeError as error:
        assert all(problem.path.startswith(ROOT) and problem.message for problem in error.problems)  # noqa: PT017
    else:
        assert tree.topics


def test_the_leaves_in_xml_equal_those_of_the_short_form():
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


def test_an_invalid_condition_in_xml_is_reported_with_its_line():
    with pytest.raises(TreeError) as caught:
        load_xml(written('\n<Value topic="/battery" type="t/msg/Battery" holds="percent > 1"/>'), fields=fields)
    assert_golden(
        "tree_problems",
        [str(problem) for problem in caught.value.problems],
        "spec.monitoring.xml",
        "line 2, column 1",
        "'percent'",
        "'percentage'",
    )
