"""The rules of the kinds as the API server evaluates them; that it does the same is tested with it (tests/cluster)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from understudy.api.schema.definitions import VALIDATIONS, definitions
from understudy.cli.manifests import cel


def _rules(schema: dict[str, Any]) -> Iterator[dict[str, str]]:
    yield from schema.get(VALIDATIONS, ())
    for inner in (schema.get("items"), schema.get("additionalProperties"), *schema.get("properties", {}).values()):
        if isinstance(inner, dict):
            yield from _rules(inner)


def test_every_rule_of_every_kind_is_compiled() -> None:
    schemas = [d["spec"]["versions"][0]["schema"]["openAPIV3Schema"] for d in definitions().values()]
    rules = [rule for schema in schemas for rule in _rules(schema)]
    assert len(rules) > 50
    for rule in rules:
        cel.compiled(rule["rule"])
        cel.compiled(rule.get("messageExpression", "''"))


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("self.a == 1 && !(self.b > 2) || false", True),
        ("self.a != 1 ? 'x' : 'y' + \"z\"", "yz"),
        ("has(self.a) && !has(self.c) && has(self.d.e)", True),
        ("size(self.list) == 3 && self.list.size() <= 3", True),
        ("self.list.all(x, x > 0) && self.list.exists(x, x == 2)", True),
        ("self.list.exists_one(x, x >= 2)", False),
        ("self.list.filter(x, x != 2)", [1, 3]),
        ("self.d.all(key, key == 'e')", True),
        ("[has(self.a), has(self.c)].filter(x, x).size() == 1", True),
        ("self.text in ['a', '1.5s'] && duration(self.text) > duration('1s')", True),
        (r"self.text.matches(r'^[0-9.]+s$') && self.text.contains('.') && self.text.startsWith('1')", True),
        ("self.text.endsWith('m') || self.a < 1", False),
    ],
)
def test_expressions_are_evaluated(expression: str, value: object) -> None:
    variables = {"a": 1, "b": 2, "list": [1, 2, 3], "d": {"e": 0}, "text": "1.5s"}
    assert cel.compiled(expression)({"self": variables}) == value


def test_a_dollar_matches_only_the_end_of_the_text() -> None:
    assert cel.matches("a", "^a$")
    assert not cel.matches("a\n", "^a$")


@pytest.mark.parametrize("expression", ["self.b", "self.a + 'x'", "self.a.all(x, x)", "duration('soon')", "other"])
def test_an_expression_without_a_value_is_undecided(expression: str) -> None:
    with pytest.raises(cel.Undecided):
        cel.compiled(expression)({"self": {"a": 1}})


@pytest.mark.parametrize(
    "expression",
    ["", "self.", "self.map(x, x)", "regex(self)", "has(self)", "(self", "self self", "'a\\n'", "self @ 1"],
)
def test_an_unsupported_expression_is_refused_at_compilation(expression: str) -> None:
    with pytest.raises(cel.Unsupported):
        cel.compiled(expression)
