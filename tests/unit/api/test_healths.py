"""Why a workload is as it is."""

from __future__ import annotations

import pytest

from understudy.api.conditions import Condition, Status, condition
from understudy.api.health_reasons import decisive, why


def reported(type_: str, status: Status, reason: str) -> Condition:
    return condition(type_, status, reason, f"{type_}: {reason}")


ALL = [
    reported("Degraded", "True", "NotWell"),
    reported("Recovering", "True", "FailureDetected"),
    reported("Healthy", "False", "Failed"),
]


@pytest.mark.parametrize(
    ("health", "words"),
    [
        ("Healthy", "a is in control"),
        ("Degraded", "Degraded: NotWell"),
        ("Failed", "Recovering: FailureDetected"),
        ("Recovering", "Recovering: FailureDetected"),
        ("Starting", "Healthy: Failed"),
    ],
)
def test_each_health_is_explained_by_a_condition(health: str, words: str) -> None:
    assert why(health, "a", ALL) == words


def test_past_conditions_and_those_of_another_instance_do_not_explain_the_health() -> None:
    past = [reported("Recovering", "False", "Recovered"), reported("Healthy", "False", "Failed")]
    assert why("Failed", "a", past) == "Healthy: Failed"
    assert why("Failed", "", past) == "it has failed"
    assert decisive("Unknown", "a", ALL) is None
