"""The limits on the depth and the number of values of an object."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from tests.support.nested_values import nested
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.nesting import DEEPEST, MOST_VALUES


def spec(levels: int) -> dict[str, Any]:
    return {"monitoring": {"yaml": {"topic": json.loads(nested(levels))}}, "strategies": [{"type": "Restart"}]}


def test_a_field_at_the_limit_is_read_and_written() -> None:
    found = FailurePolicySpec.model_validate(spec(DEEPEST))
    written = json.loads(json.dumps(found.to_wire()))
    assert written["monitoring"]["yaml"] == spec(DEEPEST)["monitoring"]["yaml"]


def test_a_field_above_the_limit_is_refused() -> None:
    with pytest.raises(ValidationError) as caught:
        FailurePolicySpec.model_validate(spec(DEEPEST + 2))
    (error,) = caught.value.errors()
    assert error["loc"] == ("monitoring", "yaml")
    assert str(DEEPEST) in error["msg"]


def wide(values: int) -> dict[str, Any]:
    """A spec whose tree has so many values in it."""
    found = spec(2)
    found["monitoring"]["yaml"] = {"parallel": [0] * (values - 1)}
    return found


@pytest.mark.parametrize("of", [0, [], {}, [0]])
def test_a_field_with_too_many_values_is_refused(of: Any) -> None:
    """The functions that visit all values of a field would keep the event loop busy."""
    assert FailurePolicySpec.model_validate(wide(MOST_VALUES)).monitoring.yaml is not None
    found = wide(MOST_VALUES)
    found["monitoring"]["yaml"]["more"] = [of]
    with pytest.raises(ValidationError) as caught:
        FailurePolicySpec.model_validate(found)
    (error,) = caught.value.errors()
    assert error["loc"] == ("monitoring", "yaml")
    assert str(MOST_VALUES) in error["msg"]


def test_a_selector_with_very_many_labels_is_refused() -> None:
    """An object can have 100,000, and the operator compares each of them with the labels of each workload of the namespace."""

    def selector(labels: int) -> dict[str, Any]:
        found = {"matchLabels": {f"label-{index}": "" for index in range(labels)}}
        return {"readiness": "Executing", "perWorkload": 1, "workloadSelector": found}

    assert FallbackPoolSpec.model_validate(selector(64)).workload_selector.match_labels
    with pytest.raises(ValidationError) as caught:
        FallbackPoolSpec.model_validate(selector(65))
    assert [error["loc"] for error in caught.value.errors()] == [("workloadSelector", "matchLabels")]
