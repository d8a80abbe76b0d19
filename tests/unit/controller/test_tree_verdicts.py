"""What the operator reports of the trees of an object: all problems of its procedures, and the cost of all of its trees together."""

from __future__ import annotations

import pytest

from tests.unit.controller.world import policy
from understudy.controller.observed import policy_reader, tree_verdicts
from understudy.controller.observed.tree_verdicts import MOST_SECONDS, Unjudged, looked_up
from understudy.controller.plan import Problem
from understudy.trees.languages.tree_check import INVALID, TOO_COSTLY, TreeText, Verdict

TREES = [TreeText("health", "yaml", "{}", name) for name in ("a", "b", "c", "d")]


def problem(verdicts: dict[str, Verdict | None], first: int = 0) -> Problem | None:
    """Return the problem of trees with these verdicts, of which so many are no procedures."""
    with looked_up(lambda tree: verdicts.get(tree.path, Verdict())):
        return tree_verdicts.problem(TREES[:first], TREES[first:])


def test_trees_are_valid_if_each_is() -> None:
    assert problem({}) is None


@pytest.mark.parametrize(("first", "message"), [(0, "no b; no d"), (2, "no b"), (4, "no b")])
def test_problems_of_procedures_are_reported_together(first: int, message: str) -> None:
    refused = {"b": Verdict(INVALID, "no b"), "d": Verdict(INVALID, "no d")}
    assert problem({**refused}, first) == Problem(INVALID, message)


def test_the_trees_of_an_object_have_a_common_cost() -> None:
    half = Verdict(cost=0.51 * MOST_SECONDS)
    found = problem({"a": half, "c": half, "d": None})
    assert found is not None
    assert found.reason == TOO_COSTLY
    assert found.message.startswith("c: with this tree, ")


def test_no_further_tree_is_checked_after_one_that_is_too_costly() -> None:
    assert problem({"a": Verdict(TOO_COSTLY, "a: why"), "b": None}) == Problem(TOO_COSTLY, "a: why")


def test_what_was_not_checked_yet_is_neither_valid_nor_refused() -> None:
    with looked_up(lambda tree: None), pytest.raises(Unjudged) as caught:
        policy_reader.problem(policy("Restart"), {})
    assert caught.value.tree.path == "spec.monitoring.yaml"
    assert policy_reader.problem(policy("Restart"), {}) is None
