"""What the status of robots and pools comes to."""

from __future__ import annotations

from typing import Any

import pytest

from tests.support import fleet
from tests.support.fleet import condition
from tests.support.golden import assert_golden
from understudy.cli.common.errors import CommandError
from understudy.cli.common.robots import UNWATCHED, pool, robot


def problems(*conditions: Any, **more: Any) -> list[tuple[str, str]]:
    name = "robot-1"
    found = robot(fleet.workload(name, status=fleet.status(name, "abcde", 1, *conditions, **more)))
    return [(problem.about, problem.reason) for problem in found.problems]


def test_a_healthy_robot_has_no_problems() -> None:
    found = robot(fleet.well())
    assert found.is_well
    assert (found.health, found.active, found.epoch) == ("Healthy", "robot-17-navigation-x8v2m", 41)
    assert found.problems == []
    assert found.last_recovery is not None
    assert found.last_recovery.strategy == "Fallback/Executing"
    assert found.last_recovery.recovery_seconds == pytest.approx(0.509)
    assert found.last_recovery.ended == fleet.ago(252.6 - 0.561)


def test_a_robot_with_a_mux_is_well_and_a_switch_that_nobody_commits_is_reported() -> None:
    found = robot(fleet.muxed())
    assert (found.gate, found.active, found.problems) == ("Mux", "robot-17-navigation-x8v2m", [])
    assert robot(fleet.well()).gate == "NetworkPolicy"
    switched = robot(fleet.muxed(condition("GateEnforced", "Unknown", "SwitchedByMux")))
    assert [problem.reason for problem in switched.problems] == ["SwitchedByMux"]


def test_a_degraded_robot_is_well_and_reported() -> None:
    found = robot(fleet.degraded())
    assert found.is_well
    assert [problem.type for problem in found.problems] == ["Degraded"]


def test_a_robot_without_a_monitor_does_not_keep_its_last_health() -> None:
    found = robot(fleet.unwatched())
    assert found.health == UNWATCHED
    assert not found.is_well


@pytest.mark.parametrize("health", ["Failed", "Recovering", "Starting", "Unknown"])
def test_a_robot_without_an_active_instance_is_not_well_even_if_protected(health: str) -> None:
    name = "robot-1"
    assert not robot(fleet.workload(name, status=fleet.status(name, "abcde", 1, health=health))).is_well


def test_one_cause_is_reported_once_and_protection_comes_first() -> None:
    name = "robot-19-navigation"
    found = robot(fleet.unprotected())
    assert [problem.type for problem in found.problems] == ["Protected"]
    assert found.problems[0].since is not None
    both = [condition("GateEnforced", "False", "NotEnforced"), condition("Protected", "False", "PoolEmpty")]
    assert problems(*both) == [("not protected", "PoolEmpty"), ("gate not enforced", "NotEnforced")]
    assert problems(condition("Ready", "False", "PoolEmpty"), *both) == problems(*both)
    gate, read = (condition(type_, "False", "ReaderWithoutProfile") for type_ in ("GateEnforced", "OutputsRead"))
    assert problems(gate, read) == [("gate not enforced", "ReaderWithoutProfile")]
    assert problems(condition("GateEnforced", "False", "NotEnforced"), read) == [
        ("gate not enforced", "NotEnforced"),
        ("outputs bypass the gate", "ReaderWithoutProfile"),
    ]
    assert robot(fleet.workload(name)).problems[0].reason == "NotSeen"


def test_a_running_or_failed_recovery_is_a_problem() -> None:
    assert problems(condition("Recovering", "True", "FailureDetected")) == [("recovering", "FailureDetected")]
    assert problems(condition("Recovering", "False", "NothingVerified")) == [("not recovered", "NothingVerified")]
    assert problems(condition("Recovering", "False", "HealthyAgain")) == []


def test_an_expected_delay_is_not_a_problem() -> None:
    assert (
        problems(condition("GateEnforced", "Unknown", "Settling"), condition("Degraded", "Unknown", "Starting")) == []
    )
    assert problems(condition("OutputsRead", "Unknown", "NobodyReads")) == []


def test_an_unknown_condition_is_reported_by_its_name() -> None:
    assert problems(condition("Painted", "False", "NoPaint")) == [("Painted", "NoPaint")]


def test_an_unobserved_spec_is_reported_as_not_accepted() -> None:
    assert problems(observed_generation=fleet.GENERATION - 1) == [("not accepted", "NotSeen")]


def test_a_status_of_a_later_version_is_refused_with_a_cure() -> None:
    item = fleet.well()
    item["status"]["health"] = "Splendid"
    with pytest.raises(CommandError, match=r"fleet/robot-17-navigation: status.health: .*the version of the operator"):
        robot(item)


def test_the_gate_reports_a_new_recovery_and_the_active_instance_before_the_status() -> None:
    item = fleet.well()
    found = robot(item, fleet.gate(item, fleet.under_way()), fleet.NOW)
    assert (found.health, found.active, found.epoch) == ("Recovering", "robot-17-navigation-w7h5k", 42)
    assert not found.is_well
    assert found.recovering is not None
    assert [(one.about, one.reason, one.message, one.since) for one in found.problems] == [
        ("recovering", "FailureDetected", found.recovering.message, fleet.ago(1))
    ]
    closed = robot(item, fleet.gate(item, fleet.under_way(), active="", epoch=43), fleet.NOW)
    assert (closed.active, closed.epoch) == ("", 43)


def test_a_gate_without_news_changes_nothing() -> None:
    item = fleet.well()
    assert robot(item, fleet.gate(item, None), fleet.NOW) == robot(item)
    assert robot(item, fleet.gate(item, fleet.under_way(id="r3")), fleet.NOW) == robot(item)


def test_a_recovery_in_both_gate_and_status_is_reported_once() -> None:
    name, began = "robot-17-navigation", fleet.NOW - 40
    since = {"health": "Recovering", "failing_since": fleet.ago(40.5)}
    said_too = condition("Recovering", "True", "FailureDetected", "no /cmd_vel for 500 ms", since=40)
    item = fleet.workload(name, status=fleet.status(name, "x8v2m", 41, said_too, **since))
    found = robot(item, fleet.gate(item, fleet.under_way(began=began, strategy="Restart"), active=""), fleet.NOW)
    (problem,) = found.problems
    assert_golden("command_line", problem.message, "/cmd_vel", "500 ms", "Restart", "robot-17-navigation-w7h5k")
    assert (found.health, found.active) == ("Recovering", "")


def test_a_wait_for_a_pod_in_the_status_replaces_the_message_of_the_gate() -> None:
    name = "robot-17-navigation"
    waits = condition(
        "Recovering", "True", "WaitingForPod", "the workload has waited since 14:02:11 UTC (position 2 of 3)", since=40
    )
    item = fleet.workload(name, status=fleet.status(name, "x8v2m", 41, waits, health="Recovering"))
    found = robot(item, fleet.gate(item, fleet.under_way(began=fleet.NOW - 40), active=""), fleet.NOW)
    assert [(one.reason, one.message) for one in found.problems] == [("WaitingForPod", waits.message)]
    assert found.recovering is not None


def test_an_unwatched_robot_is_not_reported_as_recovering() -> None:
    item = fleet.unwatched()
    found = robot(item, fleet.gate(item, fleet.under_way()), fleet.NOW)
    assert (found.health, found.recovering) == (UNWATCHED, None)
    assert [problem.type for problem in found.problems] == ["Protected"]


def test_a_pool_with_too_few_pods_is_reported() -> None:
    assert pool(fleet.spare()).is_short
    assert not pool(fleet.spare(ready=4)).is_short
    assert not pool(fleet.hot()).is_short, "a standby that drives is one of those that should be there"
    assert pool(fleet.short_of_one()).is_short
