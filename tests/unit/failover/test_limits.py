"""Each limit alone: whether it is in force, and until when."""

from __future__ import annotations

from typing import Any

import pytest

from understudy.api.kinds.failure_policy import Budget, FailurePolicySpec, StormGuard
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.limits import budget, cooldown, pause, storm
from understudy.failover.limits.backoff import FIRST, MOST, Backoff
from understudy.failover.progress import rfc3339

NOW = 1_000_000.0


def policy(**more: Any) -> FailurePolicySpec:
    monitoring = {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}}
    return FailurePolicySpec.model_validate({"monitoring": monitoring, "strategies": [{"type": "Restart"}], **more})


@pytest.mark.parametrize(("until", "expected"), [(NOW + 60, NOW + 60), (NOW - 1, None), (None, None)])
def test_a_pause_lasts_until_its_end_or_until_it_is_removed(until: float | None, expected: float | None) -> None:
    found = pause.in_force(
        Pause(reason="a new gripper", owner="ann", until=rfc3339(until) if until is not None else None), NOW
    )
    assert (found is None) == (until == NOW - 1)
    assert found is None or found.until == expected
    assert pause.in_force(None, NOW) is None


@pytest.mark.parametrize(
    ("ended", "until"),
    [(None, None), (NOW - 3, NOW + 2), (NOW - 5, None), (NOW + 100, NOW + 5)],
    ids=["no recovery", "just ended", "expired", "clock of the other node is ahead"],
)
def test_a_cooldown_lasts_from_the_end_of_a_recovery(ended: float | None, until: float | None) -> None:
    found = cooldown.in_force(policy(limits={"cooldown": "5s"}), ended, NOW)
    assert (found.until if found is not None else None) == until


def test_a_policy_with_priority_safety_has_no_cooldown() -> None:
    assert cooldown.in_force(policy(limits={"cooldown": "5s"}, priority="Safety"), NOW, NOW) is None


def test_each_backoff_is_twice_the_previous_one_up_to_a_maximum() -> None:
    backoff, waits = Backoff(), []
    for _ in range(7):
        backoff = backoff.failed(NOW, policy())
        waits.append(backoff.not_before - NOW)
    assert waits == [FIRST, 2 * FIRST, 4 * FIRST, 8 * FIRST, 16 * FIRST, MOST, MOST]
    assert backoff.healthy().failed(NOW, policy()).not_before == NOW + FIRST
    assert backoff.failed(NOW, policy(priority="Safety")).step == FIRST
    assert backoff.in_force(NOW + MOST - 1) is not None
    assert backoff.in_force(NOW + MOST) is None
    assert backoff.cleared(NOW).in_force(NOW) is None


def test_a_clock_that_is_set_back_does_not_prolong_a_backoff() -> None:
    assert Backoff().after(10.0, NOW).at(NOW - 3600).not_before == NOW - 3590


def _policy_in_a_storm(since: float, status: str = "True") -> dict[str, Any]:
    condition = {"type": "Storm", "status": status, "message": "4 of 6", "lastTransitionTime": rfc3339(since)}
    return {"status": {"conditions": [condition]}}


def test_a_storm_lasts_while_the_operator_reports_it_but_at_most_for_hold_for() -> None:
    guard = StormGuard(hold_for="1m")
    found = storm.in_force(guard, _policy_in_a_storm(NOW - 10), NOW)
    assert found is not None
    assert (found.words, found.until) == ("4 of 6", NOW + 50)
    assert storm.in_force(guard, _policy_in_a_storm(NOW - 60), NOW) is None
    assert storm.in_force(guard, _policy_in_a_storm(NOW - 10, "False"), NOW) is None
    assert storm.in_force(guard, None, NOW) is None


def test_a_budget_is_spent_until_the_window_moves_on_or_somebody_resumes() -> None:
    limit = Budget(recoveries=2, within="100s")
    assert budget.in_force(limit, [NOW - 10], None, NOW) is None
    found = budget.in_force(limit, [NOW - 90, NOW - 10], None, NOW)
    assert found is not None
    assert found.until == NOW + 10
    assert budget.in_force(limit, [NOW - 90, NOW - 10], NOW - 5, NOW) is None
