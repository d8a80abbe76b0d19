"""Health trees in OpenSCENARIO 2: they are the trees of the short form, and what is wrong with one is said with its place."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.trees.arbitrary_texts import garbled, loads_or_is_refused
from tests.unit.trees.osc_texts import LEAF, load_osc, problems, scenario
from tests.unit.trees.replays import POLICIES, SCRIPTS, TREES, Replay, named, numbers, shape
from tests.unit.trees.scenarios import ScenarioWriter
from understudy.api.base import LONGEST_TEXT
from understudy.trees.languages.osc import tokens
from understudy.trees.languages.osc.library import ACTIONS, MODIFIERS
from understudy.trees.languages.short.health_loader import load


def same(text: str, tree: dict[str, Any]) -> None:
    """That a text is the same tree as one of the short form."""
    found, expected = load_osc(text), load(tree)
    assert shape(found) == shape(expected)
    assert found.topics == expected.topics


# -- what is written, in the short form -----------------------------------------------------------------------------

SCAN = {"topic": {"name": "/scan", "gap": "1s"}}
ODOM = {"topic": {"name": "/odom", "rate": "9 to 11 Hz", "window": "3s", "type": "nav_msgs/msg/Odometry"}}
ODOM_OSC = 'topic("/odom", "nav_msgs/msg/Odometry", rate_min: 9Hz, rate_max: 11Hz, window: 3s)'


@pytest.mark.parametrize(
    ("lines", "tree"),
    [
        ([LEAF], SCAN),
        (["topic(topic_name: '/scan', gap: 1000 ms)"], SCAN),
        (["topic(", '    "/scan",', "# why", "    gap: 1s", ")"], SCAN),
        ([ODOM_OSC], ODOM),
        ([f"lidar: {LEAF}"], {**SCAN, "name": "lidar"}),
        ([f"|front-lidar.1|: {LEAF}"], {**SCAN, "name": "front-lidar.1"}),
        ([f"|on|: {LEAF}"], {**SCAN, "name": "on"}),
        (['topic("/a", rate_above: 8Hz)'], {"topic": {"name": "/a", "rate": "> 8 Hz"}}),
        (['topic("/a", rate_min: 0.5hertz)'], {"topic": {"name": "/a", "rate": ">= 0.5 Hz"}}),
        (['topic("/a", rate_below: 1.5kHz)'], {"topic": {"name": "/a", "rate": "< 1500 Hz"}}),
        (['topic("/a", rate_max: 20Hz, gap: 2min)'], {"topic": {"name": "/a", "rate": "<= 20 Hz", "gap": "2m"}}),
        (["serial:", f"    {LEAF}", f"    {ODOM_OSC}"], {"sequence": [SCAN, ODOM]}),
        (["one_of:", f"    {LEAF}", f"    {ODOM_OSC}"], {"selector": [SCAN, ODOM]}),
        (["sensors: parallel:", f"  {LEAF}", "", f"  {ODOM_OSC}"], {"parallel": [SCAN, ODOM], "name": "sensors"}),
        ([f"{LEAF} with:", "    inverter()"], {"inverter": SCAN}),
        (["serial:", f"    {LEAF}", "with:", "    inverter()"], {"inverter": {"sequence": [SCAN]}}),
        (
            [f"{LEAF} with:", '    while_task_active("/go", "a/action/Go", settle: 3s)'],
            {"while": {"task_active": {"action": "/go", "type": "a/action/Go"}}, "settle": "3s", "do": SCAN},
        ),
        (
            [f"{LEAF} with:", "    inverter()", '    while_task_active(action_name: "/go")'],
            {"inverter": {"while": {"task_active": {"action": "/go"}}, "do": SCAN}},
        ),
        (
            [r"""value("/b", "a/msg/B", holds: "x > 1 and t == \'a\"\'", recovers: "x > 2", for: 1s)"""],
            {"value": {"topic": "/b", "type": "a/msg/B", "holds": "x > 1 and t == 'a\"'", "recovers": "x > 2", "for": "1s"}},
        ),
        (
            ['diagnostics(status: "camera: driver", worst: level!WARN)'],
            {"diagnostics": {"name": "camera: driver", "worst": "WARN"}},
        ),
        (['publisher("/plan", 2, "/planner")'], {"publisher": {"topic": "/plan", "count": 2, "node": "/planner"}}),
    ],
)  # fmt: skip
def test_each_node_is_equivalent_to_one_of_the_short_form(lines: list[str], tree: dict[str, Any]) -> None:
    same(scenario(*lines), {"parallel": [tree]})


def test_a_scenario_may_be_one_leaf_without_a_final_line_break() -> None:
    same(f"import osc.understudy\nscenario a:\n  do {LEAF}", SCAN)


def test_windows_line_breaks_are_accepted() -> None:
    same(scenario("serial:", f"    {LEAF}").replace("\n", "\r\n"), {"parallel": [{"sequence": [SCAN]}]})


def test_parameters_of_the_scenario_are_constants() -> None:
    parameters = 'lidar, other: string = "/scan"\nlongest: time = 1s\ntwice: time = longest\nworst: level = level!OK'
    same(
        scenario("topic(lidar, gap: twice)", "diagnostics(worst: worst)", parameters=parameters),
        {"parallel": [SCAN, {"diagnostics": {"worst": "OK"}}]},
    )


# -- the same trace ------------------------------------------------------------------------------------------------


@settings(max_examples=120, deadline=None)
@given(tree=TREES, seed=st.integers(0, 2**32), script=SCRIPTS, grace=st.sampled_from([0.0, 0.7, 4.0, 30.0]))
def test_a_tree_written_in_openscenario_gives_the_same_trace(
    tree: dict[str, Any], seed: int, script: list[tuple[float, str]], grace: float
) -> None:
    short = named(tree, numbers())
    text = ScenarioWriter(random.Random(seed).randrange).file(short)
    found, expected = load_osc(text, grace=grace), load(short, grace=grace)
    assert sorted(found.topics, key=lambda topic: topic.name) == sorted(expected.topics, key=lambda topic: topic.name)
    assert Replay(found, grace).trace(script) == Replay(expected, grace).trace(script), text


@pytest.mark.parametrize("policy", POLICIES)
def test_the_policies_of_the_examples_are_equal_in_openscenario(policy: dict[str, Any]) -> None:
    tree = policy["spec"]["monitoring"]["yaml"]
    for seed in range(5):
        found, expected = load_osc(ScenarioWriter(random.Random(seed).randrange).file(tree)), load(tree)
        assert found.topics == expected.topics
        assert [name for kind, name in shape(found) if kind.endswith("Leaf")] == [
            name for kind, name in shape(expected) if kind.endswith("Leaf")
        ]


# -- bounds ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (" " * (LONGEST_TEXT + 1), f"the text has {LONGEST_TEXT + 1} characters; it may have {LONGEST_TEXT}"),
        ("a " * 32_000, f"the text has more than {tokens.MOST} words and signs"),
        (scenario("topic(" + "(" * 9_000), f"more than {tokens.DEEPEST_BRACKETS} nested brackets"),
        (scenario("topic(a: f" + "()" * 9_000 + ")"), "'(' is not for health trees: calculations are not supported; write the value"),
        (scenario("topic(a: a" + ".a" * 9_000 + ")"), "a health tree has no actors and no fields; "
                                                      "remove the dot and what is before it"),
        (f"import osc{'.a' * 9_900}\n", "the nesting is too deep"),
        (
            scenario(*(f"{'  ' * level}serial:" for level in range(40))),
            f"more than {tokens.DEEPEST_BLOCK} nested blocks",
        ),
        (scenario(f"{LEAF} with:", *["    inverter()"] * 2_000), "inverter(): the tree is more than 32 levels deep"),
        (scenario(*(f'l{i}: topic("/scan", gap: 1s)' for i in range(600))), "topic(): the tree has more than 512 nodes"),
    ],
    ids=["long", "words", "brackets", "calls", "dots", "import", "blocks", "modifiers", "nodes"],
)  # fmt: skip
def test_a_text_that_exceeds_a_limit_is_refused(text: str, expected: str) -> None:
    found = problems(text)
    assert found[0].partition(": ")[2] == expected
    assert len(found) <= 2


def test_the_number_of_reported_mistakes_is_limited() -> None:
    found = problems(scenario(*["nothing()"] * 500))
    assert (len(found), found[-1]) == (101, "spec.monitoring.osc: and 1 more")


# -- anything at all ------------------------------------------------------------------------------------------------

WHOLE = scenario(
    f"|front-lidar|: {LEAF}",
    "driving: serial:",
    '    topic("/cmd_vel", "geometry_msgs/msg/Twist", rate_min: 8Hz, rate_max: 1.5kHz, window: 2s)  # why',
    "with:",
    '    while_task_active(action_name: "/go", settle: long)',
    'diagnostics(worst: level!WARN, status: "a") with:',
    "    inverter()",
    parameters="long: time = 2s",
)

PIECES = [
    *ACTIONS, *MODIFIERS, *tokens.REFUSED, "scenario", "do", "with:", "import", "serial:", "one_of:", "run_process", "string",
    "\n", "\n    ", "\n        ", "\n\t", "\r", "\f", "(", ")", "((((((", ":", ",", '"', "'", '"""', "|", "\\", "!", "=", ".", "..", "#",
    "/*", "*/", "0x1F", "1e9", "-", "500ms", "8Hz", "\0", "\ud800", "\u2028", "é", " ", "        ",
]  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32), changes=st.integers(1, 12))
def test_a_changed_text_loads_or_is_refused(seed: int, changes: int) -> None:
    refused_or_loads(garbled(WHOLE, PIECES, seed=seed, changes=changes))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.sampled_from(PIECES) | st.text(max_size=5), max_size=60))
def test_fragments_in_any_order_load_or_are_refused(pieces: list[str]) -> None:
    refused_or_loads("import osc.understudy\nscenario a:\n    do parallel:\n        " + " ".join(pieces))


def refused_or_loads(text: str) -> None:
    loads_or_is_refused(load_osc, text, "spec.monitoring.osc")
