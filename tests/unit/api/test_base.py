"""Durations, and rules that say what would be right."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from understudy.api.base import Model, pattern_rule, rules, seconds
from understudy.api.kinds.failure_policy import Limits, Strategy
from understudy.api.kinds.robot_workload import RobotWorkloadSpec


@pytest.mark.parametrize(
    ("text", "length"),
    [
        ("500ms", 0.5),
        ("1.5s", 1.5),
        ("0s", 0.0),
        ("2m", 120.0),
        ("1h", 3600.0),
        ("1m30s", 90.0),
        ("1h0m0.5s250ms", 3600.75),
    ],
)
def test_durations_are_converted_to_seconds(text: str, length: float) -> None:
    assert seconds(text) == pytest.approx(length)


@pytest.mark.parametrize("text", ["", "5", "5 s", "s", "-1s", "1d", ".5s", "1,5s", "1e3s", "5S", "500ms\n"])
def test_an_invalid_duration_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a duration: write a number with ms, s, m or h"):
        seconds(text)
    with pytest.raises(ValidationError):
        Limits(cooldown=text)


def test_fields_are_camel_case_on_the_wire_and_empty_ones_are_omitted() -> None:
    strategy = Strategy.model_validate({"type": "Restart", "verifyWithin": "2s"})
    assert strategy.verify_within == "2s"
    assert strategy.to_wire() == {"type": "Restart", "verifyWithin": "2s"}
    assert Strategy(type="Restart", verify_within="2s") == strategy


def test_unknown_fields_of_a_newer_version_are_ignored() -> None:
    assert Strategy.model_validate({"type": "Restart", "fromTheFuture": 1}).to_wire() == {
        "type": "Restart",
        "verifyWithin": "30s",
    }


def test_omitted_parts_have_their_defaults() -> None:
    spec = RobotWorkloadSpec.model_validate(
        {
            "workloadRef": {"kind": "Deployment", "name": "nav2"},
            "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
            "failurePolicyRef": {"name": "navigation"},
        }
    )
    assert (spec.ros.domain_id, spec.ros.discovery.mode, spec.gate.kind) == (0, "Managed", "NetworkPolicy")
    assert spec.outputs[0].name == "/cmd_vel"


def test_a_rule_names_the_field_if_one_is_given() -> None:
    assert rules(("a", "b"), ("c", "d", ".e"))["x-kubernetes-validations"] == [
        {"rule": "a", "message": "b"},
        {"rule": "c", "message": "d", "fieldPath": ".e"},
    ]


def test_the_message_of_a_pattern_contains_the_refused_value() -> None:
    (rule,) = pattern_rule("^a+$", "write as")["x-kubernetes-validations"]
    assert rule["rule"] == "self.matches(r'^a+$')"
    assert rule["messageExpression"] == """'"' + self + '": write as'"""


def test_a_model_accepts_both_names_of_a_field() -> None:
    class Example(Model):
        """An example."""

        two_words: int = 0

    assert Example(two_words=1) == Example.model_validate({"twoWords": 1})
