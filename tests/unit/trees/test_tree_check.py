"""What the check of one tree costs at most, and what it returns."""

from __future__ import annotations

import json

import pytest

from tests.unit.trees.osc_texts import scenario
from understudy.trees.languages.osc import tokens
from understudy.trees.languages.text.source_map import MOST_IN_VALUES
from understudy.trees.languages.tree_check import INVALID, TOO_COSTLY, TreeText, check

STEP = {"set_lifecycle": {"node": "/amcl", "state": "inactive"}}


def repeated(uses: int, characters: int) -> str:
    """A procedure with a request of so many characters in a subtree that it uses so often."""
    request = f"a: [{', '.join('1' for _ in range(characters // 3))}]"
    uses_of_b = '<SubTree ID="b"/>' * uses
    return (
        f'<root BTCPP_format="4" main_tree_to_execute="a"><BehaviorTree ID="a"><Sequence>{uses_of_b}</Sequence></BehaviorTree>'
        f'<BehaviorTree ID="b"><CallService service="/a" type="a/srv/B" request="{request}"/></BehaviorTree></root>'
    )


def test_a_procedure_is_returned_in_the_short_form() -> None:
    verdict = check(TreeText("procedure", "yaml", json.dumps(STEP), "p"))
    assert (verdict.reason, json.loads(verdict.tree)) == ("", STEP)


def test_a_health_tree_has_no_form_that_anybody_needs() -> None:
    tree = json.dumps(scenario('topic("/scan", gap: 1s)'))
    assert json.loads(check(TreeText("health", "osc", tree, "p", 30.0)).tree) is None


def test_a_small_text_with_many_uses_of_a_long_value_is_refused_before_all_are_read() -> None:
    few = check(TreeText("procedure", "xml", json.dumps(repeated(3, 3000)), "p"))
    assert not few.reason
    many = check(TreeText("procedure", "xml", json.dumps(repeated(200, 3000)), "p"))
    assert many.reason == INVALID
    assert f"the values of the tree have more than {MOST_IN_VALUES} characters" in many.message
    assert many.message.count("characters") == 1


def test_a_procedure_that_is_long_in_the_short_form_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("understudy.trees.languages.tree_check.LONGEST_TREE", 20)
    verdict = check(TreeText("procedure", "yaml", json.dumps(STEP), "p"))
    assert verdict.reason == TOO_COSTLY
    assert verdict.message.startswith("p: in the short form it has 57 characters, and 20 are allowed")


def test_no_more_tokens_are_read_than_a_text_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    read = 0
    token = tokens.Token

    def counted(*args: object) -> object:
        nonlocal read
        read += 1
        return token(*args)  # type: ignore[arg-type]

    monkeypatch.setattr("understudy.trees.languages.osc.grammar.Token", counted)
    verdict = check(TreeText("health", "osc", json.dumps(scenario("." * 57_000)), "p"))
    assert f"more than {tokens.MOST} words and signs" in verdict.message
    assert read <= tokens.MOST + 2000
