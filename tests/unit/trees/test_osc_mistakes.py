"""Mistakes in OpenSCENARIO 2 files are reported with their place and the way out."""

from __future__ import annotations

import sys

import pytest

from tests.support.golden import assert_golden
from tests.unit.trees.osc_texts import LEAF, load_osc, problems, scenario
from understudy.trees.languages.osc.library import ACTIONS, MODIFIERS
from understudy.trees.source.positions import TextOffset
from understudy.trees.source.problems import TreeError

# -- mistakes -------------------------------------------------------------------------------------------------------

FRONT = 'topic("/a", gap: '


def test_a_missing_parser_is_reported_with_the_extra_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "antlr4", None)
    with pytest.raises(TreeError, match="install understudy with the extra osc"):
        load_osc(scenario('topic("/read_by_no_other_test", gap: 1s)'))


@pytest.mark.parametrize(
    ("node", "column", "expected"),
    [
        ("topik()", 1, "topik(): unknown behaviour, did you mean 'topic'?"),
        (
            "nothing_of_ours()",
            1,
            f"nothing_of_ours(): unknown behaviour; known are {', '.join((*ACTIONS, *MODIFIERS))}",
        ),
        (
            'run_process("reboot")',
            1,
            "run_process(): is not for health trees: a health tree starts no processes and reads no files; "
            "write what must hold, such as topic() or value()",
        ),
        (
            "inverter()",
            1,
            "inverter(): is a modifier; write it in the with: of the node that it is for: with: inverter()",
        ),
        (f"{LEAF} with:\n            invert()", 13, "invert(): unknown modifier, did you mean 'inverter'?"),
        (
            f"{LEAF} with:\n            retry(3)",
            13,
            "retry(): is not for health trees: a health tree is evaluated continuously; remove it, and give the leaf in it "
            "a longer gap or window",
        ),
        (
            f"{LEAF} with:\n            topic()",
            13,
            "topic(): is a node of its own; put it beside the other, in a parallel:",
        ),
        (
            f"{LEAF} with:\n            inverter(3)",
            22,
            "inverter(): found argument number 1; it takes none",
        ),
        ("topic(gap: 1s)", 1, "topic() topic_name: missing; give the topic's fully qualified name, such as /cmd_vel"),
        ('topic("scan", gap: 1s)', 7, "topic() topic_name: found 'scan'; did you mean '/scan'?"),
        (
            'topic("/a")',
            1,
            "topic(): neither gap nor a rate is given; give gap, such as 500ms, or rate_above, such as 8Hz",
        ),
        ('topic("/a", gab: 1s)', 13, "topic() gab: unknown argument, did you mean 'gap'?"),
        ('topic("/a", gap: 1s, gap: 2s)', 22, "topic() gap: is given twice; remove one of them"),
        (
            'topic("/a", type: "b/msg/C")',
            13,
            "'type' is a word of OpenSCENARIO and no argument; write topic_type, or action_type of an action",
        ),
        (f"{FRONT}5)", 18, "topic() gap: found 5, which has no unit; give a time, such as 500ms or 2s"),
        (
            f'{FRONT}"1s")',
            18,
            'topic() gap: found "1s", which is a text; remove the quotes; give a time, such as 500ms or 2s',
        ),
        (f"{FRONT}1m)", 18, "topic() gap: found 1m, and m is the metre in OpenSCENARIO; write min for minutes"),
        (f"{FRONT}1sek)", 18, "topic() gap: found 1sek, and sek is no unit of time, did you mean 'sec'?"),
        (f"{FRONT}-1s)", 18, "topic() gap: found -1s; give a time, such as 500ms or 2s, above 0 and below 1000000000"),
        (f"{FRONT}0s)", 18, "topic() gap: found '0s'; it must be longer than 0"),
        (
            f"{FRONT}longest)",
            18,
            "topic() gap: there is no parameter 'longest'; the scenario has none; give it, or a time, such as 500ms or 2s",
        ),
        (f"{FRONT}1s + 1s)", 21, "'+' is not for health trees: calculations are not supported; write the value"),
        (
            'topic("/a", rate_min: 1Hz, rate_below: 5Hz)',
            40,
            "topic(): found rate_min and rate_below; give one of them, or rate_min and rate_max",
        ),
        (
            'topic("/a", rate_min: 11Hz, rate_max: 9Hz)',
            39,
            "topic() rate_max: no rate is within '11 Hz to 9 Hz': write the lower bound first, such as '9 to 11 Hz'",
        ),
        (
            'topic("/a", gap: 1s, window: 2s)',
            30,
            "topic() window: a window is only for a rate; give rate_above or another bound, or remove window",
        ),
        ("diagnostics(worst: WARN)", 20, "diagnostics() worst: found WARN; did you mean level!WARN?"),
        ("diagnostics(worst: level!WARM)", 20, "diagnostics() worst: found level!WARM, did you mean 'WARN'?"),
        (
            'publisher("/a", count: "2")',
            24,
            'publisher() count: found "2"; give a whole number, such as 1',
        ),
        (
            "wait elapsed(3s)",
            1,
            "'wait' is not for health trees: a health tree takes no action, and neither waits nor sends events; remove it. "
            "Use gap for how long something may be missing",
        ),
        (
            "robot.topic()",
            6,
            "a health tree has no actors and no fields; remove the dot and what is before it",
        ),
        (
            f"|a b|: {LEAF}",
            1,
            "|a b|: name: found 'a b'; a node's name is 1 to 63 letters, digits, '_', '-' and '.'",
        ),
        ("on: topic()", 1, "'on' is a word of OpenSCENARIO and no name; write |on|"),
        (
            "topic(",
            7,
            "this is not OpenSCENARIO 2: found the end of the line; there should be '(', ')', a text in quotes, a number or a name",
        ),
        ('topic("/a)', 7, "this is not OpenSCENARIO 2: "
                          "the string that begins here is not closed on its line; close the quotes, and write \\ before quotes in it"),
        ('topic(gap = 1s)', 11, "this is not OpenSCENARIO 2: found '='; write ':' between the name of an argument and its value"),
        ("topic() $", 9, "this is not OpenSCENARIO 2: found '$', with which no word of the language begins; remove it"),
        ("topic())", 8, "closes a bracket that is not open; remove it"),
        ("serial", 7, "this is not OpenSCENARIO 2: found the end of the line; there should be ':' or '('"),
        ("serial:", 8, "this is not OpenSCENARIO 2: found the end of the line; there should be an indented line"),
        ('topic("a\\x")', 7, "topic() topic_name: found '\\\\x' in a text; known are \\\\, \\\", \\', \\n and \\t"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_node_is_reported_with_its_place_and_the_valid_values(
    node: str, column: int, expected: str
) -> None:
    """The column is that in the last line of the node, of which the first is indented by 8."""
    more = node.count("\n")
    assert problems(scenario(node)) == [f"line {4 + more}, column {column if more else column + 8}: {expected}"]


HEAD = "import osc.understudy\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            f"scenario a:\n    do {LEAF}\n",
            "line 1, column 1: the text: does not import its library; begin it with: import osc.understudy",
        ),
        (
            f"{HEAD}scenario a\n    do {LEAF}\n",
            "line 2, column 11: this is not OpenSCENARIO 2: an indented block follows, so this line must end with ':'",
        ),
        (
            HEAD,
            "line 1, column 1: the text: has no scenario; give it one: scenario healthy: with do parallel: in it",
        ),
        (
            f'import "/etc/passwd"\nscenario a:\n    do {LEAF}\n',
            'line 1, column 8: import "/etc/passwd": no files are read; write what is in that file here, and import osc.understudy',
        ),
        (
            f"import osc.helpers\nscenario a:\n    do {LEAF}\n",
            "line 1, column 8: import osc.helpers: has behaviours that a health tree cannot have; import osc.understudy "
            "instead",
        ),
        (
            f"import osc.understudi\nscenario a:\n    do {LEAF}\n",
            "line 1, column 8: import osc.understudi: there is no such library, did you mean 'osc.understudy'?",
        ),
        (
            f"{HEAD}scenario a\n",
            "line 2, column 1: scenario a: does nothing; give it a do, such as do parallel: with the leaves in it",
        ),
        (
            f"{HEAD}scenario a:\n    do {LEAF}\nscenario b:\n    do {LEAF}\n",
            "line 4, column 1: scenario b: there is one in line 2 already; a health tree is one scenario",
        ),
        (
            f"{HEAD}scenario a:\n    do {LEAF}\n    do {LEAF}\n",
            "line 4, column 5: do: there is one in line 3 already; put both into one do parallel:",
        ),
        (
            f"{HEAD}scenario a:\n    inverter()\n    do {LEAF}\n",
            "line 3, column 5: inverter(): is written in the with: of the node that it is for, and not of scenario a",
        ),
        (
            f"{HEAD}scenario a:\n    long: time\n    do {LEAF}\n",
            "line 3, column 5: parameter long: it has no value; write one after it, with = and a time, such as 500ms or 2s",
        ),
        (
            f"{HEAD}scenario a:\n    long: tim = 3s\n    do {LEAF}\n",
            "line 3, column 5: parameter long: there is no type 'tim', did you mean 'time'?",
        ),
        (
            f'{HEAD}scenario a:\n    long: time = 3Hz\n    do topic("/a", gap: long)\n',
            "line 3, column 18: parameter long: found 3Hz, and Hz is no unit of time; known are ms, s, min, h, millisecond, sec, "
            "second, minute, hour",
        ),
        (
            f'{HEAD}scenario a:\n    long: string = "a"\n    do topic("/a", gap: long)\n',
            "line 4, column 25: topic() gap: the parameter long is of type string; give a time, such as 500ms or 2s",
        ),
        (
            f"{HEAD}action reboot:\n    now: bool\n",
            "line 2, column 1: 'action' is not for health trees: a policy can declare only one scenario and its parameters; "
            "all other names come with import osc.understudy",
        ),
        (
            f"{HEAD}scenario a:\n    def f() -> string is external os.system()\n    do {LEAF}\n",
            "line 3, column 5: 'def' is not for health trees: a health tree takes no action and calls no functions; remove it",
        ),
        (
            "  import osc.understudy\n",
            "line 1, column 3: the first line is indented; begin it in the first column of the text",
        ),
        (
            scenario("serial:", f"    {LEAF}", f"  {LEAF}"),
            "line 6, column 11: is indented like none of the blocks around it; begin the lines of a block in the same column",
        ),
        (
            scenario(LEAF, LEAF),
            "line 5, column 9: topic(): 'scan' is already the name of topic() in line 4, column 9; give one of them another name",
        ),
        (
            scenario("parallel() :", f"    {LEAF}"),
            None,
        ),
        (
            scenario("serial(3):", f"    {LEAF}"),
            "line 4, column 16: serial:: takes no arguments; remove the brackets",
        ),
    ],
)  # fmt: skip
def test_a_mistake_in_the_file_structure_is_reported(text: str, expected: str | None) -> None:
    if expected is None:
        assert load_osc(text).topics
    else:
        assert problems(text) == [expected]


def test_a_value_that_is_not_text_is_refused() -> None:
    assert_golden("tree_problems", problems({"topic": {}}), "spec.monitoring.osc")


def test_all_semantic_mistakes_are_reported_at_once_in_text_order() -> None:
    found = problems(scenario('topic("a", gap: 0s)', "nothing()", "serial:", '    topic("/b", gap: 3)'))
    assert [line.split(": ")[:2] for line in found] == [
        ["line 4, column 15", "topic() topic_name"],
        ["line 4, column 25", "topic() gap"],
        ["line 5, column 9", "nothing()"],
        ["line 7, column 30", "topic() gap"],
    ]


def test_places_are_relative_to_the_file_that_contains_the_text() -> None:
    for text in (scenario("topik()"), scenario("topic($)"), scenario("wait")):
        with pytest.raises(TreeError) as caught:
            load_osc(text, begins=TextOffset(lines=10, columns=6))
        place = caught.value.problems[0].path
        assert place in ("spec.monitoring.osc, line 14, column 15", "spec.monitoring.osc, line 14, column 21")
