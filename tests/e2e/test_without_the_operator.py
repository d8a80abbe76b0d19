"""A failover works while the operator is down: the monitor needs nobody."""

from __future__ import annotations

import pytest

from tests.e2e.scenario import Robot
from tests.e2e.test_strategies import assert_handed_over

pytestmark = pytest.mark.alone


@pytest.mark.long
@pytest.mark.parametrize(
    ("strategy", "expected"), [("uninitialized", "Fallback/Uninitialized"), ("restarting", "Restart")]
)
def test_a_failover_works_with_the_operator_scaled_to_nothing(
    strategy: str, expected: str, gate_kind: str, request: pytest.FixtureRequest
) -> None:
    robot: Robot = request.getfixturevalue(strategy)
    old = robot.wait_protected()
    request.getfixturevalue("without_operator")
    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == expected
    assert_handed_over(robot, recovery)


def test_a_second_failover_works_too_since_kubernetes_itself_replaces_the_pod(
    executing: Robot, request: pytest.FixtureRequest
) -> None:
    old = executing.wait_protected()
    request.getfixturevalue("without_operator")
    executing.fail(old, "killed")
    first = executing.wait_recovered(1)
    assert first.strategy == "Fallback/Executing"
    assert_handed_over(executing, first)
    executing.wait_standby()
    executing.fail(first.new, "killed")
    second = executing.wait_recovered(2)
    assert second.strategy == "Fallback/Executing"
    assert_handed_over(executing, second)
