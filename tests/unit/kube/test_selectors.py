"""Label selectors match as the API server does."""

from __future__ import annotations

import pytest

from understudy.kube import selectors
from understudy.kube.client import Object


@pytest.mark.parametrize(
    ("selector", "labels", "matched"),
    [
        ({}, {}, True),
        ({"matchLabels": {"a": "1"}}, {"a": "1", "b": "2"}, True),
        ({"matchLabels": {"a": "1"}}, {"a": "2"}, False),
        ({"matchExpressions": [{"key": "a", "operator": "NotIn", "values": ["1"]}]}, {}, True),
        ({"matchExpressions": [{"key": "a", "operator": "In", "values": ["1", "2"]}]}, {"a": "2"}, True),
        ({"matchExpressions": [{"key": "a", "operator": "Exists"}]}, {"b": ""}, False),
        ({"matchExpressions": [{"key": "a", "operator": "DoesNotExist"}]}, {"b": ""}, True),
    ],
)
def test_a_selector_matches_by_all_its_requirements(selector: Object, labels: dict[str, str], matched: bool) -> None:
    assert selectors.matches(selector, labels) is matched


@pytest.mark.parametrize("labels", [{}, {"a": "1"}, {"a": "2"}, {"b": "1"}, {"a": "1", "b": "x"}])
def test_a_negated_requirement_matches_exactly_the_other_labels(labels: dict[str, str]) -> None:
    for requirement in selectors.requirements(
        {
            "matchLabels": {"a": "1"},
            "matchExpressions": [
                {"key": "a", "operator": "NotIn", "values": ["2"]},
                {"key": "b", "operator": "Exists"},
                {"key": "b", "operator": "DoesNotExist"},
            ],
        }
    ):
        matched = selectors.matches({"matchExpressions": [requirement]}, labels)
        opposite = selectors.matches({"matchExpressions": [selectors.opposite(requirement)]}, labels)
        assert matched is not opposite


def test_the_text_of_a_selector_is_in_the_format_of_requests() -> None:
    selector = {
        "matchLabels": {"a": "1"},
        "matchExpressions": [
            {"key": "b", "operator": "In", "values": ["x", "y"]},
            {"key": "c", "operator": "DoesNotExist"},
            {"key": "d", "operator": "NotIn", "values": ["z"]},
            {"key": "e", "operator": "Exists"},
        ],
    }
    assert selectors.as_text(selector) == "a=1,b in (x,y),!c,d notin (z),e"
