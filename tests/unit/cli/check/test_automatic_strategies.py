"""What is found in policies that leave their strategies to be chosen."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.given import POLICY, POOL, WORKLOAD, found, only

AUTO = POLICY.replace("{type: Restart}", "{type: Auto}") + "  requirements: {availability: High, resourceUsage: High}\n"


def test_pools_that_give_what_is_required_have_no_warning() -> None:
    assert found(AUTO, WORKLOAD, POOL) == []


def test_requirements_that_the_pools_do_not_meet_are_told_where_they_are_written() -> None:
    finding = only(AUTO, WORKLOAD)
    assert (finding.severity, finding.field, finding.place.line) == ("warning", "spec.requirements", 9)
    assert_golden("check", finding.message, "RobotWorkload", "robot-17", "500 ms", "4.67 s", "FallbackPool")


def test_a_pool_that_serves_others_does_not_count() -> None:
    fields = [finding.field for finding in found(AUTO, WORKLOAD, POOL.replace("app: navigation", "app: nav"))]
    assert fields == ["spec.requirements", "spec.workloadSelector"]


def test_safety_high_wants_safe_commands() -> None:
    policy = AUTO.replace("availability: High", "safety: High")
    assert only(policy, WORKLOAD, POOL).message.endswith("set spec.safety in the policy")


def test_requirements_beside_written_strategies_ask_for_nothing() -> None:
    assert found(AUTO.replace("{type: Auto}", "{type: Restart}"), WORKLOAD, POOL) == []


@pytest.mark.parametrize("broken", ["requirements: High", "requirements: {safety: 1}", "requirements: [High]"])
def test_what_is_no_requirement_is_told_once(broken: str) -> None:
    text = AUTO[: AUTO.index("  requirements")] + f"  {broken}\n"
    assert all(finding.severity == "error" for finding in found(text, WORKLOAD))


@pytest.mark.parametrize("recoveries", ["none", "[1]", "[{id: a}]", "{a: b}"])
def test_a_status_of_any_kind_is_no_obstacle(recoveries: str) -> None:
    assert found(AUTO, WORKLOAD + f"status: {{recoveries: {recoveries}}}\n", POOL) == []
