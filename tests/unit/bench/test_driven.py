"""What the log of a robot says of a time in which nothing failed."""

from __future__ import annotations

import pytest
from understudy_demo.recovery import Recovered
from understudy_demo.robotview import RobotLog

from bench.driven import Row, add_driven, driven, robots_table
from bench.results import Report
from tests.unit.bench import robot_logs

PERIOD = 0.05


def log(*parts: tuple[str, float, float]) -> RobotLog:
    return robot_logs.log(*parts, period=PERIOD)


def test_an_instance_that_drives_all_the_time_is_neither_left_nor_replaced() -> None:
    found = driven(log(("a", 0, 130)), 10, 130)
    assert (found.switches, found.recoveries, found.changes) == (0, 0, ())
    assert found.commands == 120 / PERIOD
    assert found.gaps == (pytest.approx(PERIOD), pytest.approx(PERIOD))


def test_what_happened_before_the_begin_and_after_the_end_does_not_count() -> None:
    found = driven(log(("a", 0, 9), ("b", 9.2, 70), ("c", 70.2, 80)), 10, 70)
    assert (found.switches, found.recoveries) == (0, 0)


def test_a_switch_has_the_time_without_a_command_and_both_instances() -> None:
    found = driven(log(("a", 0, 20), ("b", 20.15, 60)), 0, 60)
    (change,) = found.changes
    assert (change.before, change.after, change.seconds) == ("a", "b", pytest.approx(0.15))
    assert (found.switches, found.recoveries) == (1, 1)


def test_an_instance_that_comes_back_until_it_is_fenced_makes_one_switch() -> None:
    found = driven(log(("a", 0, 20), ("b", 20.15, 20.15), ("a", 20.2, 20.3), ("b", 20.35, 60)), 0, 60)
    assert len(found.changes) == 3
    assert (found.switches, found.recoveries) == (1, 1)


def test_a_reader_that_goes_back_for_good_switched_but_nothing_was_replaced() -> None:
    found = driven(log(("a", 0, 20), ("b", 20.15, 20.15), ("a", 20.2, 60)), 0, 60)
    assert (found.switches, found.recoveries) == (1, 0)


def test_a_standby_that_was_replaced_unnoticed_after_a_short_switch_is_no_recovery() -> None:
    found = driven(log(("a", 0, 20), ("b", 20.15, 20.15), ("a", 20.2, 40), ("c", 40.15, 60)), 0, 60)
    assert (found.switches, found.recoveries) == (2, 1)


def test_a_gap_belongs_to_the_minute_in_which_it_ends() -> None:
    found = driven(log(("a", 0, 59.7), ("a", 60.2, 200)), 0, 180)
    assert found.gaps == tuple(pytest.approx(gap) for gap in (0.3, 0.5, PERIOD))


def test_a_minute_without_a_command_has_a_gap_as_long_as_the_silence_at_its_end() -> None:
    found = driven(log(("a", 0, 30), ("a", 190, 200)), 0, 200)
    assert found.gaps == tuple(pytest.approx(gap) for gap in (30, 90, 150, 160))


def test_a_log_without_commands_is_one_gap() -> None:
    found = driven(RobotLog(), 0, 90)
    assert (found.commands, found.switches, found.recoveries, found.gaps) == (0, 0, 0, (60, 90))


def test_the_table_has_a_row_for_each_robot_and_a_robot_without_a_standby_has_no_switches() -> None:
    leaves, reflex = Row("leaves", 0, [81.0, 157.0, 202.0]), Row("reflex", 1, [90.0], switches=2, armed=1)
    head, first, second = (line.split() for line in robots_table([leaves, reflex]).splitlines())
    assert head[0] == "robot"
    assert first[:5] == ["leaves", "3", "-", "-", "0"]
    assert first[-3:] == ["2", "2", "1"], "minutes above 100, 150 and 200 ms"
    assert second == ["reflex", "1", "1", "2", "1", "90", "/", "90", "/", "90", "ms", "0", "0", "0"]


def test_the_results_bound_the_switches_and_explain_them_by_the_statuses_of_the_same_time() -> None:
    report = Report("soak")
    found = driven(log(("a", 0, 20), ("b", 20.15, 60)), 0, 60)
    recorded = [
        Recovered(n, "late", "Recovered", "reflex", "a", "b", n, 0.1, {}, {"detected": at})
        for n, at in ((1, -5.0), (2, 20.1))
    ]
    add_driven(report, "100 ms reflex", found, recorded, 0.0, most=0)
    assert not report.held
    written = report.json()
    assert written["figures"]["100 ms reflex: needless switches of the reader"]["values"] == [1]
    assert written["figures"]["100 ms reflex: worst gap of /cmd_vel, each minute"]["values"] == [pytest.approx(150)]
    assert list(written["notes"]) == ["100 ms reflex: change 1", "100 ms reflex: recovery 2 in its status"]
