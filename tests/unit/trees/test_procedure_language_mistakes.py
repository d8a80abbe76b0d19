"""Mistakes in procedures of the other languages are reported with their place."""

from __future__ import annotations

import pytest

from tests.unit.trees.osc_texts import load_osc
from tests.unit.trees.procedure_texts import ACTIVE, ACTIVE_OSC, ACTIVE_XML, PATH, file, problems, scenario
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.positions import TextOffset
from understudy.trees.source.problems import TreeError

# -- mistakes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ('<SetLifecycle node="amcl" state="active"/>', "<SetLifecycle> node: found 'amcl'; did you mean '/amcl'?"),
        (
            '<SetLifecycle node="/amcl" state="on"/>',
            "<SetLifecycle> state: found 'on'; give one of unconfigured, inactive, active, finalized",
        ),
        ("<SetLifecycel/>", "<SetLifecycel>: unknown node, did you mean 'SetLifecycle'?"),
        (
            '<Condition ID="SetLifecycle"/>',
            '<Condition ID="SetLifecycle">: SetLifecycle is an Action; write <SetLifecycle>',
        ),
        (
            "<CallService service='/a' type='b/srv/C' request='json:{\"x\": }'/>",
            "<CallService> request: found '{\"x\": }', which is not JSON: Expecting value at character 7; "
            'write it as in json:{"data": "hello"}',
        ),
        (
            '<CallService service="/a" type="b/srv/C" request="{x: 1}"/>',
            "<CallService> request: found '{x: 1}'; braces alone are a blackboard entry, and a mapping has json: in front, such as "
            'json:{"data": "hello"}',
        ),
        (
            '<CallService service="/a" type="b/srv/C" request="5"/>',
            "<CallService> request: found 5; request is a mapping of fields",
        ),
        (
            "<SetParameters node='/a' values='json:{\"x\": {\"z\": 1}}'/>",
            "<SetParameters> values: found a mapping; a parameter is a value or a list of them",
        ),
        (
            f"<Inverter>{ACTIVE_XML}{ACTIVE_XML}</Inverter>",
            "<Inverter>: has 2 nodes in it; give it one, such as a <Sequence> with the others in it",
        ),
        (
            f'<Timeout msec="5s">{ACTIVE_XML}</Timeout>',
            "<Timeout> msec: found '5s'; give a whole number of milliseconds, such as 5000",
        ),
        (f"<Timeout>{ACTIVE_XML}</Timeout>", "<Timeout> msec: missing; timeout has within and do"),
        (
            f'<RetryUntilSuccessful num_attempts="-1">{ACTIVE_XML}</RetryUntilSuccessful>',
            "<RetryUntilSuccessful> num_attempts: found -1; give the number of attempts, from 1 to 1000",
        ),
        (
            f'<RetryUntilSuccessful num_attempts="often">{ACTIVE_XML}</RetryUntilSuccessful>',
            "<RetryUntilSuccessful> num_attempts: found 'often'; give the number of attempts, from 1 to 1000",
        ),
        (
            f'<Parallel success_count="1">{ACTIVE_XML}{ACTIVE_XML}</Parallel>',
            "<Parallel>: success_count=1 and failure_count=1 of 2: remove both: the first failure ends it. If one is "
            "enough, write <Fallback>, which tries one after the other",
        ),
        (
            f"<ReactiveSequence>{ACTIVE_XML}</ReactiveSequence>",
            "<ReactiveSequence>: is not for procedures: a procedure runs each node once, in order; write <Sequence>",
        ),
        (
            f"<ForceSuccess>{ACTIVE_XML}</ForceSuccess>",
            "<ForceSuccess>: is not for procedures: write what to do after a failure as the next node, in a <Fallback>",
        ),
        (
            f'<Delay delay_msec="100">{ACTIVE_XML}</Delay>',
            "<Delay>: is not for procedures: <WaitFor>, or a condition such as <Topic>, says what to wait for; remove it",
        ),
        (
            '<Motion topic="/a"/>',
            "<Motion>: is not for procedures: it judges the active instance only, and this one is not active yet; remove it",
        ),
        (
            '<SetLifecycle node="/amcl" state="active" _skipIf="idle"/>',
            "<SetLifecycle> _skipIf: scripts are not run; write what must hold before a node in front of it, in a <Sequence>",
        ),
        (
            f"<SetLifecycle>{ACTIVE_XML}</SetLifecycle>",
            "<SetLifecycle>: has a node in it, but a leaf cannot have nodes in it: put them next to it",
        ),
    ],
)  # fmt: skip
def test_a_mistake_in_xml_is_reported_with_its_place_and_the_valid_values(node: str, expected: str) -> None:
    assert problems("xml", file(f"  {node}")) == [f"line 3, column 3: {expected}"]


@pytest.mark.parametrize(
    ("node", "column", "expected"),
    [
        ('set_lifecycle("amcl", lifecycle_state!active)', 15, "set_lifecycle() node: found 'amcl'; did you mean '/amcl'?"),
        ('set_lifecycle("/amcl", active)', 24, "set_lifecycle() state: found active; did you mean lifecycle_state!active?"),
        ('set_lifecycel("/amcl")', 1, "set_lifecycel(): unknown behaviour, did you mean 'set_lifecycle'?"),
        (
            'call_service("/a", "b/srv/C", "{x: ")',
            31,
            "call_service() request: found '{x:', which is not YAML: while parsing a flow node, expected the "
            "node content, but found '<stream end>'; write it as in {data: hello}",
        ),
        (
            'call_service("/a", "b/srv/C", expect: "{x: 1, x: 2}")',
            39,
            "call_service() expect: 'x' is given twice; remove one of them",
        ),
        ('wait_for("/a", "b/msg/C", within: 5)', 35, "wait_for() within: found 5, which has no unit; give a time, such as 500ms or 2s"),
        ('restore_state(only: "/a")', 15, "'only' is a word of OpenSCENARIO and no argument; write names"),
        ("retry(3)", 1, "retry(): is a modifier; write it in the with: of the node that it is for: with: retry()"),
        (
            "motion()",
            1,
            "motion(): is not for procedures: it judges the active instance only, and this one is not active yet; remove it",
        ),
        (
            'run_process("reboot")',
            1,
            "run_process(): is not for procedures: no processes are started and no files read; write what is done to the instance, "
            "such as call_service()",
        ),
        (
            "wait elapsed(3s)",
            1,
            "'wait' is not for procedures: use wait_for() to wait, and timeout() in the with: of a node to limit the time; "
            "remove it",
        ),
    ],
)  # fmt: skip
def test_a_mistake_in_openscenario_is_reported_with_its_place_and_the_valid_values(
    node: str, column: int, expected: str
) -> None:
    assert problems("osc", scenario(node)) == [f"line 4, column {column + 8}: {expected}"]


ONLY = ": is not for checks: a check takes no action; it belongs in a procedure"


@pytest.mark.parametrize(
    ("form", "text", "expected"),
    [
        ("xml", file(ACTIVE_XML), f"line 3, column 1: <SetLifecycle>{ONLY}"),
        (
            "xml",
            file('<Timeout msec="1"><NodePresent node="/a"/></Timeout>'),
            f"line 3, column 1: <Timeout>{ONLY}",
        ),
        ("osc", scenario(ACTIVE_OSC), f"line 4, column 9: set_lifecycle(){ONLY}"),
        (
            "osc",
            scenario('node_present("/a") with:', "    retry(3)"),
            f"line 5, column 13: retry(){ONLY}",
        ),
    ],
)  # fmt: skip
def test_a_check_contains_only_conditions_in_every_language(form: str, text: str, expected: str) -> None:
    assert problems(form, text, check=True) == [expected]


def test_a_health_tree_refuses_the_steps_of_procedures() -> None:
    with pytest.raises(TreeError, match=r"set_lifecycle\(\): is not for health trees: a health tree takes no action"):
        load_osc(scenario(ACTIVE_OSC))


@pytest.mark.parametrize("form", ["xml", "osc"])
def test_a_value_that_is_not_text_is_refused(form: str) -> None:
    assert problems(form, ACTIVE)[0].startswith("bringUp: found a mapping; give the text of ")


def test_all_mistakes_are_reported_at_once_with_their_places() -> None:
    text = file(
        '<Sequence>\n<SetLifecycle node="a" state="b"/>\n<Publish topic="/a" type="b" message="json:"/>\n</Sequence>'
    )
    with pytest.raises(TreeError) as caught:
        compose("xml", text, check=False, path=PATH, begins=TextOffset(lines=10, columns=4))
    places = [str(problem).split(": ")[:2] for problem in caught.value.problems]
    assert places == [
        ["bringUp, line 14, column 5", "<SetLifecycle> node"],
        ["bringUp, line 14, column 5", "<SetLifecycle> state"],
        ["bringUp, line 15, column 5", "<Publish> message"],
        ["bringUp, line 15, column 5", "<Publish> type"],
    ]
