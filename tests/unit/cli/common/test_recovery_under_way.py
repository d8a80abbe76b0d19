"""What a gate says about a recovery, compared with the status."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from understudy.api import names
from understudy.api.kinds.robot_workload import Attempt, RobotWorkloadStatus
from understudy.cli.common.recovery_under_way import UnderWay, under_way
from understudy.cli.common.robots import status_of
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import LASTS, PodIdentity, Progress
from understudy.kube.client import Object

STATUS = status_of(fleet.well())


def in_progress(
    progress: Progress | None, *, status: RobotWorkloadStatus = STATUS, now: float = fleet.NOW
) -> UnderWay | None:
    return under_way(status, fleet.gate(fleet.well(), progress), now)


def message(**changes: Any) -> str:
    found = in_progress(fleet.under_way(**changes))
    assert found is not None
    return found.message


def test_a_recovery_in_progress_has_its_occasion_start_and_strategy() -> None:
    found = in_progress(fleet.under_way())
    assert found is not None
    assert (found.occasion, found.since, found.strategy) == ("FailureDetected", fleet.ago(1), "Fallback/Executing")
    assert_golden(
        "command_line", found.message, "/cmd_vel", "500 ms", "Fallback/Executing", "robot-17-navigation-w7h5k"
    )


def test_the_message_contains_the_known_details_of_the_attempt() -> None:
    assert_golden("command_line", message(target=None), "/cmd_vel", "500 ms", "Fallback/Executing")
    assert message(strategy="") == "no /cmd_vel for 500 ms.", "as a monitor of an earlier version commits it"
    waiting = Waiter(workload="w", pool="navigation-spare", since=fleet.NOW - 1, until=fleet.NOW + 60)
    assert_golden(
        "command_line",
        message(strategy="Fallback/Uninitialized", waiting=waiting),
        "Fallback/Uninitialized",
        "navigation-spare",
    )


def test_a_failed_strategy_is_listed_once() -> None:
    attempts = [Attempt(strategy="Fallback/Executing", result="NotVerified") for _ in range(2)]
    assert_golden(
        "command_line",
        message(strategy="Restart", target=PodIdentity(name="w-9", uid="u"), attempts=attempts),
        "/cmd_vel",
        "500 ms",
        "Restart",
        "w-9",
        "Fallback/Executing",
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"id": "r3"},
        {"began": fleet.NOW - 300},
        {"result": "Failed"},
        {"switchover": "Drain", "planned": True},
        {"moments": {"detected": fleet.NOW - 1, "held": fleet.NOW - 0.9}},
    ],
    ids=["in the status", "older than the last there", "over", "a switchover", "held"],
)
def test_a_finished_or_already_reported_recovery_is_ignored(changes: dict[str, Any]) -> None:
    assert in_progress(fleet.under_way(**changes)) is None


def test_without_a_gate_or_a_readable_record_there_is_no_recovery() -> None:
    assert under_way(STATUS, None, fleet.NOW) is None
    assert in_progress(None) is None
    unreadable: Object = fleet.gate(fleet.well(), None)
    unreadable["metadata"]["annotations"][names.RECOVERY] = "{"
    assert under_way(STATUS, unreadable, fleet.NOW) is None
    del unreadable["metadata"]["annotations"]
    assert under_way(STATUS, unreadable, fleet.NOW) is None


def test_a_recovery_that_the_status_omits_for_long_counts_as_abandoned() -> None:
    began = fleet.NOW - 1
    assert in_progress(fleet.under_way(), now=began + LASTS - 0.1) is not None
    assert in_progress(fleet.under_way(), now=began + LASTS) is None


def test_a_recovery_that_the_status_confirms_has_no_time_limit() -> None:
    going_on = STATUS.model_copy(update={"health": "Recovering", "failing_since": fleet.ago(1.5)})
    assert in_progress(fleet.under_way(), status=going_on, now=fleet.NOW + 600) is not None


def test_a_status_about_another_recovery_does_not_confirm_the_gate_record() -> None:
    another = STATUS.model_copy(update={"health": "Recovering", "failing_since": fleet.ago(-500)})
    assert in_progress(fleet.under_way(), status=another, now=fleet.NOW + 600) is None, "that one has not committed yet"
