"""The limit on the depth of fields with unknown content."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from tests.support.nested_values import nested
from understudy.api.kinds.failure_policy import FailurePolicySpec
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
