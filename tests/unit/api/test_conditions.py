"""Conditions keep the time of their last transition."""

from __future__ import annotations

import re

import pytest
from pydantic import ValidationError

from understudy.api.conditions import MESSAGE_MOST, Condition, condition, merged, now

LONG_AGO = "2020-01-01T00:00:00Z"


def _old(type_: str, status: bool) -> Condition:
    return condition(type_, status, "Before", "old", generation=1).model_copy(update={"last_transition_time": LONG_AGO})


def test_now_is_formatted_as_in_kubernetes() -> None:
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", now())


@pytest.mark.parametrize(
    ("value", "status"), [(True, "True"), (False, "False"), ("Unknown", "Unknown"), ("True", "True")]
)
def test_a_boolean_becomes_a_status(value: object, status: str) -> None:
    assert condition("Ready", value, "Tested", "tested").status == status  # type: ignore[arg-type]


def test_an_unchanged_status_keeps_its_time_and_takes_the_other_fields() -> None:
    (result,) = merged([_old("Ready", True)], [condition("Ready", True, "After", "new", generation=2)])
    assert result.last_transition_time == LONG_AGO
    assert (result.reason, result.message, result.observed_generation) == ("After", "new", 2)


def test_a_changed_status_takes_the_present_time() -> None:
    (result,) = merged([_old("Ready", True)], [condition("Ready", False, "After", "new")])
    assert result.last_transition_time != LONG_AGO
    assert result.status == "False"


def test_new_types_are_added_and_old_ones_removed() -> None:
    result = merged(
        [_old("Gone", True), _old("Ready", True)],
        [condition("Ready", True, "R", "r"), condition("New", True, "R", "r")],
    )
    assert [c.type for c in result] == ["Ready", "New"]


def test_merging_does_not_change_its_input() -> None:
    new = condition("Ready", True, "After", "new")
    before = new.last_transition_time
    merged([_old("Ready", True)], [new])
    assert new.last_transition_time == before


@pytest.mark.parametrize("reason", ["", "two words", "9Lives", "Trailing:"])
def test_a_reason_must_be_one_word(reason: str) -> None:
    with pytest.raises(ValidationError):
        condition("Ready", True, reason, "refused")


def test_a_condition_is_serialized_for_the_wire() -> None:
    assert _old("Ready", True).to_wire() == {
        "type": "Ready",
        "status": "True",
        "reason": "Before",
        "message": "old",
        "lastTransitionTime": LONG_AGO,
        "observedGeneration": 1,
    }


def test_a_message_that_is_too_long_is_cut() -> None:
    found = condition("Reconciled", False, "Refused", "It is refused: " + "x" * 100_000)
    assert len(found.message) == MESSAGE_MOST
    assert found.message.startswith("It is refused: x")
    assert found.message.endswith("…")
