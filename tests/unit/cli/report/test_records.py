"""What the records of a status say of a period, and of which part of it."""

from __future__ import annotations

import pytest

from tests.support.fleet import NOW, ago, condition, recovery
from tests.unit.cli.report import fleet
from tests.unit.cli.report.fleet import DAY
from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.cli.common.errors import CommandError
from understudy.cli.report.recovery_records import Span, findings, robot_period
from understudy.cli.report.sample_statistics import Spread

HOUR = 3600.0


def close(value: float) -> object:
    return pytest.approx(value, abs=1e-4)  # moments have microseconds


def test_downtime_is_the_sum_of_the_recovery_times() -> None:
    found = robot_period(fleet.whole(), DAY)
    assert found.known == DAY
    assert found.down == close(0.509 + 0.510 + 0.511 + 3.682 + 0.008)
    assert found.availability == close(1 - found.down / DAY.length)
    assert not found.down_at_least


def test_the_time_of_forgotten_records_is_excluded() -> None:
    found = findings([fleet.forgetful(), fleet.whole()], DAY)
    forgetful = found.robot_periods[1]
    assert forgetful.known is not None
    assert (forgetful.known.begin, forgetful.forgotten) == (close(NOW - 10 * HOUR), 2)
    assert [one.robot.name for one in found.incomplete] == ["robot-2-drive"]
    known = DAY.length + 10 * HOUR
    assert found.availability == close(1 - sum(one.down for one in found.robot_periods) / known)


def test_records_older_than_the_period_make_it_complete() -> None:
    found = findings([fleet.forgetful()], Span(NOW - 5.5 * HOUR, NOW))
    assert found.incomplete == []
    assert len(found.entries) == 5


def test_a_period_older_than_all_records_is_unknown() -> None:
    found = findings([fleet.forgetful()], Span(NOW - 20 * HOUR, NOW - 15 * HOUR))
    assert found.robot_periods[0].known is None
    assert (found.robot_periods[0].availability, found.availability) == (None, None)
    assert len(found.incomplete) == 1


def test_a_robot_is_known_from_its_creation() -> None:
    found = findings([fleet.quiet()], DAY)
    assert found.robot_periods[0].known == Span(NOW - 2 * HOUR, NOW)
    assert found.robot_periods[0].availability == 1.0
    assert found.incomplete == [], "before that there was nothing to be known"


def test_downtime_of_a_failed_recovery_lasts_until_the_robot_is_healthy() -> None:
    assert robot_period(fleet.in_vain(), DAY).down == close(HOUR - 1800.0 + 3.682)


def test_downtime_of_an_ongoing_failure_lasts_until_the_end_of_the_period() -> None:
    item = fleet.robot("robot-1-drive", [fleet.failed(1, 500.0)], health="Failed", failing_since=ago(600.0))
    found = robot_period(item, DAY)
    assert (found.down, found.down_at_least) == (close(600.0), False)
    assert robot_period(fleet.robot("r", [], health="Failed", failing_since=ago(60.0)), DAY).down == close(60.0)


def test_downtime_without_a_recorded_end_is_a_lower_bound() -> None:
    unhealthy = condition("Healthy", "False", "NotWell", since=30.0)
    found = robot_period(fleet.robot("robot-1-drive", [fleet.failed(1, 500.0)], unhealthy), DAY)
    assert (found.down, found.down_at_least) == (close(64.0), True)
    later = robot_period(fleet.robot("r", [fleet.restart(2, 100.0), fleet.failed(1, 500.0)]), DAY)
    assert later.down_at_least, "when it was healthy in between, nobody has written down"
    at_once = robot_period(fleet.robot("r", [fleet.restart(2, 440.0), fleet.failed(1, 500.0)]), DAY)
    assert (at_once.down, at_once.down_at_least) == (close(64.0), False)


def test_a_failure_that_began_before_the_period_counts_only_within_it() -> None:
    found = robot_period(fleet.robot("r", [fleet.restart(1, 102.0)]), Span(NOW - 100.0, NOW))
    assert (found.entries, found.down) == ([], close(1.682))


def test_time_held_by_the_budget_is_downtime_but_in_no_part() -> None:
    held = recovery(1, 500.0)
    held.moments.held, held.moments.released = held.moments.detected, ago(500.0 - 0.503 - 40.0)
    (entry,) = robot_period(fleet.robot("r", [held]), DAY).entries
    assert (entry.held, entry.down) == (close(40.0), close(40.509))


def test_the_gap_is_the_time_between_outputs() -> None:
    found = {entry.recovery.number: entry.gap for entry in robot_period(fleet.whole(), DAY).entries}
    assert found[5] == close(0.509 + 0.031)
    assert found[1] == close(0.040), "of a switchover from the former's last output on"
    assert robot_period(fleet.in_vain(), DAY).entries[0].gap is None


def test_recoveries_without_a_failure_of_their_own_form_separate_groups() -> None:
    follows = fleet.restart(1, 700.0, follows=[DependencyRecovery(name="robot-9-drive", recovery="a")])
    found = findings([fleet.whole(), fleet.robot("robot-9-map", [follows])], DAY)
    assert {group.name: len(group.entries) for group in found.groups} == {
        "Restart": 1,
        "Restart, after a dependency's": 1,
        "Fallback/Executing": 3,
        "Fallback/Executing, failover as planned": 1,
    }


def test_the_parts_of_a_group_add_up_to_its_mean() -> None:
    for group in findings(fleet.robots(), DAY).groups:
        assert sum(group.parts.values()) == pytest.approx(group.spread.mean)
        assert group.spread.least <= group.spread.p50 <= group.spread.p95 <= group.spread.greatest


def test_quantiles_are_interpolated_linearly() -> None:
    assert (Spread.of([3.0, 1.0, 2.0]).p50, Spread.of([3.0, 1.0]).p95) == (2.0, pytest.approx(2.9))
    assert Spread.of([7.0]) == Spread(1, 7.0, 7.0, 7.0, 7.0, 7.0)


def test_an_unreadable_status_is_not_interpreted() -> None:
    item = fleet.whole()
    item["status"]["recoveries"][0]["result"] = "Sideways"
    with pytest.raises(CommandError, match="Does this command have the version of the operator"):
        findings([item], DAY)
