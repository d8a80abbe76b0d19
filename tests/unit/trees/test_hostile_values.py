"""Values that no tree needs, such as numbers with thousands of digits, are refused where they are, and raise nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest

from understudy.api.kinds.procedure_spec import Procedure
from understudy.failover.bring_up import BringUp
from understudy.trees.languages.notations import load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.languages.text.flow_values import structure_of
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.problems import TreeError
from understudy.trees.source.value_reader import MOST_UNKNOWN, found_text

HEX = "0x" + "f" * 5000
"""Python refuses to write such a number in decimal."""
BINARY = "0b" + "1" * 15_000
OCTAL = "0" + "7" * 6000
DIGITS = "9" * 5000
LARGE = str(2**64)
ESCAPE = r'"\UFFFFFFFF"'
BEYOND_UNICODE = r'"\U0011FFFF"'
DIRECTIVE = f"%YAML 1.{DIGITS}\n--- {{}}"
SURROGATE = r'"\ud800"'


def _short(value: str) -> str:
    """A test's name; pytest would write the whole text."""
    return ascii(value)[:24]


PROCEDURES: dict[str, Callable[[str], str]] = {
    "xml": lambda value: (
        '<root BTCPP_format="4"><BehaviorTree ID="A"><CallService service="/run" type="std_srvs/srv/SetBool" '
        f"request='{value}'/></BehaviorTree></root>"
    ),
    "osc": lambda value: (
        "import osc.understudy\nscenario up:\n"
        f"    do call_service('/run', service_type: 'std_srvs/srv/SetBool', request: '{value}')\n"
    ),
}


@pytest.mark.parametrize("number", [HEX, f"-{HEX}", BINARY, OCTAL, DIGITS, LARGE, f"-{2**63 + 1}"], ids=_short)
@pytest.mark.parametrize(
    ("tree", "column", "field"),
    [
        ("parallel: %s", 11, "parallel"),
        ("topic: {name: /scan, gap: %s}", 27, "topic.gap"),
        ("log: {level: ERROR, count: %s, window: 1s}", 28, "log.count"),
        ("parameter: {node: /amcl, name: a, one_of: [1, %s]}", 47, "parameter.one_of[1]"),
        ("parallel: [{topic: {%s: 1}}]", 21, "parallel[0].topic"),
    ],
)
def test_a_tree_with_a_number_beyond_64_bits_is_refused_at_its_place(
    number: str, tree: str, column: int, field: str
) -> None:
    if ": 1}" in tree and len(number) > 1000:
        tree = tree.replace("%s:", "? %s :")  # a key of more than 1,024 characters
        column += 2
    with pytest.raises(TreeError) as caught:
        load_text("yaml", tree % number, path="health", grace=1.0)
    problem = caught.value.problems[0]
    assert str(problem).startswith(f"health, line 1, column {column}: {field}: ")
    assert len(str(problem)) < 300
    assert "64 bits" in problem.message or "a key that is not a text" in problem.message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{{data: {HEX}}}", "has more than 64 bits; give a smaller number, or write it in quotes if it is a text"),
        (f"{{data: [{DIGITS}]}}", "64 bits"),
        (f'json:{{"data": {DIGITS}}}', "64 bits"),
        (f'json:{{"data": [-{LARGE}]}}', "64 bits"),
        (f'json:{{"data": {DIGITS}.0}}', "found inf; give a number"),
        ("{data: 1.0e+400}", "found 1.0e+400; give a number"),
        ("{data: .nan}", "found .nan; give a number"),
        ("{data: -.INF}", "found -.INF; give a number"),
        (f"{{data: {ESCAPE}}}", "which is not YAML: found an escape or a number that is out of range"),
        (f"{{data: {BEYOND_UNICODE}}}", "which is not YAML: found an escape"),
        (DIRECTIVE, "which is not YAML: found an escape or a number that is out of range"),
        (f"{{data: {SURROGATE}}}", "half of a character"),
        (f"{{{SURROGATE}: 1}}", "half of a character"),
        (f'json:{{"data": {SURROGATE}}}', "half of a character"),
        (f'json:{{{SURROGATE}: ""}}', "half of a character"),
    ],
    ids=_short,
)
def test_a_request_with_a_hostile_value_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        structure_of(text)
    assert len(str(caught.value)) < 400
    assert "sys.set_int_max_str_digits" not in str(caught.value)


@pytest.mark.parametrize("text", [ESCAPE, BEYOND_UNICODE, DIRECTIVE], ids=_short)
def test_a_text_that_the_yaml_parser_cannot_represent_is_refused(text: str) -> None:
    tree = text if text is DIRECTIVE else f"topic: {{name: {text}, gap: 1s}}"
    with pytest.raises(TreeError) as caught:
        load_text("yaml", tree, path="health", grace=1.0)
    assert str(caught.value).startswith("health, line 1, column ")
    assert "this is not YAML: found an escape or a number that is out of range" in str(caught.value)


@pytest.mark.parametrize("tree", [f"value: {{topic: {SURROGATE}}}", f"{SURROGATE}: 1"])
def test_a_tree_with_half_of_a_character_is_refused(tree: str) -> None:
    with pytest.raises(TreeError, match="half of a character"):
        load_text("yaml", tree, path="health", grace=1.0)


@pytest.mark.parametrize("form", PROCEDURES)
@pytest.mark.parametrize("number", [HEX, DIGITS], ids=_short)
def test_a_procedure_with_a_number_beyond_64_bits_is_refused_before_the_monitor_has_it(form: str, number: str) -> None:
    """The monitor writes the loaded procedure as JSON, with which it ended before."""
    value = f'json:{{"data": {DIGITS}}}' if form == "xml" else f"{{data: {number}}}"
    text = PROCEDURES[form](value)
    with pytest.raises(TreeError, match="64 bits") as caught:
        compose(form, text, check=False, path="bringUp")
    assert "request" in str(caught.value)
    found = BringUp.of("bringUp", Procedure.model_validate({form: text}))
    assert found is not None
    assert "64 bits" in found.problem


def test_a_procedure_from_a_mapping_in_xml_is_refused_too() -> None:
    """A request of fields without braces is YAML in XML as well."""
    with pytest.raises(TreeError, match="64 bits"):
        compose("xml", PROCEDURES["xml"](f"data: {HEX}"), check=False, path="bringUp")


def test_the_largest_numbers_of_ros_are_accepted() -> None:
    text = f"{{least: {-(2**63)}, most: {2**64 - 1}, hex: 0xffffffffffffffff, float: 1.7e+308}}"
    found = structure_of(text)
    assert found == {"least": -(2**63), "most": 2**64 - 1, "hex": 2**64 - 1, "float": 1.7e308}
    assert json.loads(json.dumps(found)) == found


@pytest.mark.parametrize(
    "value", [int(HEX, 16), -int(HEX, 16), 10**100, "x" * 100_000, 10**4299], ids=lambda value: type(value).__name__
)
def test_the_text_of_a_found_value_is_short(value: Any) -> None:
    assert 0 < len(found_text(value)) <= 60


@pytest.mark.parametrize(
    "tree",
    [
        {"topic": {"name": "/%s", "gap": "1s"}},
        {"progress": {"action": "/a/%s", "gap": "5s"}},
        {"while": {"task_active": {"action": "/%s"}}, "do": {"topic": {"name": "/scan", "gap": "1s"}}},
        {"lifecycle": {"node": "/%s"}},
    ],
)
def test_a_name_that_ros_would_refuse_is_refused(tree: dict[str, Any]) -> None:
    """ROS refuses a topic of more than 247 characters with an error that ended the monitor, also for the status of an action."""
    with pytest.raises(TreeError, match="a name may have 200 characters"):
        load_health("yaml", json.loads(json.dumps(tree).replace("%s", "x" * 240)), grace=1.0)


@pytest.mark.parametrize(
    "load",
    [
        lambda tree: load_health("yaml", tree, grace=1.0),
        lambda tree: compose("yaml", tree, check=False, path="tree"),
    ],
    ids=["health", "procedure"],
)
def test_a_tree_with_very_many_unknown_keys_has_few_problems(load: Callable[[Any], Any]) -> None:
    unknown = {f"key-{number}": number for number in range(5000)}
    with pytest.raises(TreeError) as raised:
        load({"sequence": [{"topic": {"name": "/scan", **unknown}}, unknown]})
    messages = [str(problem) for problem in raised.value.problems]
    assert len(messages) <= 3 * MOST_UNKNOWN
    assert f"the tree has more than {MOST_UNKNOWN} unknown keys" in "; ".join(messages)
