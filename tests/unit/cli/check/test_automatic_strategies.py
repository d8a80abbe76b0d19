"""What is found in policies that leave their strategies to be chosen."""

from __future__ import annotations

import pytest

from tests.support.golden import assert_golden
from tests.unit.cli.check.manifests import POLICY, POOL, WORKLOAD, found, only

AUTO = POLICY.replace("{type: Restart}", "{type: Auto}") + "  requirements: {availability: High, resourceUsage: High}\n"


def test_pools_that_meet_the_requirements_have_no_warning() -> None:
    assert found(AUTO, WORKLOAD, POOL) == []


def test_unmet_requirements_are_reported_at_their_place() -> None:
    finding = only(AUTO, WORKLOAD)
    assert (finding.severity, finding.field, finding.place.line) == ("warning", "spec.requirements", 9)
    assert_golden("check", finding.message, "RobotWorkload", "robot-17", "500 ms", "4.67 s", "FallbackPool")


def test_a_pool_that_serves_others_does_not_count() -> None:
    fields = [finding.field for finding in found(AUTO, WORKLOAD, POOL.replace("app: navigation", "app: nav"))]
    assert fields == ["spec.requirements", "spec.workloadSelector"]


def test_high_safety_requires_safe_commands() -> None:
    policy = AUTO.replace("availability: High", "safety: High")
    assert only(policy, WORKLOAD, POOL).message.endswith("set spec.safety.commands")


def test_requirements_next_to_explicit_strategies_have_no_findings() -> None:
    assert found(AUTO.replace("{type: Auto}", "{type: Restart}"), WORKLOAD, POOL) == []


@pytest.mark.parametrize("broken", ["requirements: High", "requirements: {safety: 1}", "requirements: [High]"])
def test_an_invalid_requirement_has_only_errors(broken: str) -> None:
    text = AUTO[: AUTO.index("  requirements")] + f"  {broken}\n"
    assert all(finding.severity == "error" for finding in found(text, WORKLOAD))


@pytest.mark.parametrize("recoveries", ["none", "[1]", "[{id: a}]", "{a: b}"])
def test_any_status_is_accepted(recoveries: str) -> None:
    assert found(AUTO, WORKLOAD + f"status: {{recoveries: {recoveries}}}\n", POOL) == []
