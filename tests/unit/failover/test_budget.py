"""How many recoveries a window of time has left."""

from __future__ import annotations

from understudy.failover.limits.budget import CLOCKS_DIFFER, counted, free_from, left
from understudy.failover.progress import Progress

WINDOW = 100.0


def test_the_budget_reports_the_remaining_recoveries_and_the_next_possible_start() -> None:
    assert left([], 1000.0, recoveries=2, within=WINDOW) == 2
    assert left([950.0], 1000.0, recoveries=2, within=WINDOW) == 1
    assert free_from([950.0], recoveries=2, within=WINDOW) <= 1000.0
    assert left([950.0, 990.0], 1000.0, recoveries=2, within=WINDOW) == 0
    assert free_from([950.0, 990.0], recoveries=2, within=WINDOW) == 1050.0


def test_old_recoveries_leave_the_window() -> None:
    spent = [950.0, 990.0]
    assert left(spent, 1050.0, recoveries=2, within=WINDOW) == 1
    assert free_from([*spent, 1050.0], recoveries=2, within=WINDOW) == 1090.0, "the two latest count"


def test_a_lowered_budget_counts_earlier_recoveries() -> None:
    assert free_from([950.0, 960.0, 970.0], recoveries=1, within=WINDOW) == 1070.0
    assert left([950.0, 960.0, 970.0], 1000.0, recoveries=1, within=WINDOW) == 0


def test_recoveries_before_a_resume_do_not_count() -> None:
    assert counted([950.0, 990.0], None, 1000.0) == [950.0, 990.0]
    assert counted([950.0, 990.0], 960.0, 1000.0) == [990.0]


def test_a_resume_from_the_future_is_ignored_except_for_small_clock_differences() -> None:
    assert counted([950.0], 1000.0 + CLOCKS_DIFFER, 1000.0) == []
    assert counted([950.0], 1001.0 + CLOCKS_DIFFER, 1000.0) == [950.0]


def test_a_held_recovery_counts_from_its_release_and_its_parts_exclude_the_hold() -> None:
    progress = Progress.begin("it ended", last_healthy=999.5, detected=1000.0)
    assert progress.began == 1000.0
    progress.moments["held"] = 1000.1
    progress.release(1600.0)
    progress.charge("cluster", 1600.2)
    assert progress.began == 1600.0
    progress.forget_attempt()
    assert progress.moments == {"last_healthy": 999.5, "detected": 1000.0, "held": 1000.1, "released": 1600.0}
    recovery = progress.to_recovery(1)
    assert recovery.parts is not None
    assert (recovery.parts.detection, recovery.parts.cluster) == (0.5, 0.2)
    assert recovery.moments.held is not None
