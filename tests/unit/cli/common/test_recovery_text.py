"""Recoveries as bars, words and figures."""

from __future__ import annotations

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from understudy.api.kinds.robot_workload import Attempt, Moments, Recovery
from understudy.cli.common.text.recovery_text import lines


def printed(*recoveries: Recovery, columns: int | None = 100, last: int = 3, count: int | None = None) -> list[str]:
    number = len(recoveries) if count is None else count
    return list(lines("fleet/robot-17", number, recoveries, last=last, now=fleet.NOW, columns=columns, colours=False))


def row(found: list[str], label: str) -> str:
    return next(line for line in found if line.startswith(f"    {label}"))


def test_the_bars_of_the_parts_are_consecutive_and_to_scale() -> None:
    found = printed(fleet.recoveries()[1])
    bars = {label: row(found, label) for label in ("detection", "cluster", "start-up", "re-init")}
    room, total = 100 - 27, 0.502 + 1.832 + 0.758 + 0.590
    for label, seconds in (("detection", 0.502), ("cluster", 1.832), ("start-up", 0.758), ("re-init", 0.590)):
        assert bars[label].count("█") == pytest.approx(seconds / total * room, abs=1)
    ends = [len(bar[:-9].rstrip()) for bar in bars.values()]
    begins = [17 + len(bar[17:]) - len(bar[17:].lstrip()) for bar in bars.values()]
    assert begins[0] == 17
    assert begins[1:] == pytest.approx(ends[:-1], abs=1)
    assert bars["cluster"].endswith(" 1.83 s")


def test_a_recovery_is_shown_with_its_failure_target_and_failed_attempts() -> None:
    found = printed(fleet.recoveries()[1])
    assert_golden("command_line", found[2], "#2", "2026-11-22 13:03:24", "3.68 s by Restart")
    assert_golden("command_line", found[3], "/cmd_vel", "500 ms", "/navigate_to_pose")
    assert_golden("command_line", row(found, "control"), "…-m2c7p → …-7k2xq", "gate epoch 40", "31 ms")
    assert_golden("command_line", row(found, "moments"), "detected +502 ms", "fenced +2.33 s", "started +3.09 s")
    assert_golden("command_line", row(found, "state"), "/amcl_pose 612 ms", "0.21 m", "/map")
    assert_golden("command_line", row(found, "failed"), "Fallback/Executing", "robot-17-navigation-v4d9s")


def test_all_kept_recoveries_share_one_scale() -> None:
    found = printed(*fleet.recoveries(), count=12)
    assert_golden("command_line", found[0], "robot-17", "12 recoveries")
    fast, slow = found[2], found[3]
    assert fast.endswith("509 ms")
    assert slow.endswith("3.68 s")
    shades = slow.count("░") + slow.count("█") + slow.count("▓") + slow.count("▒")
    assert fast.count("░") + fast.count("█") == pytest.approx(shades * 0.509 / 3.682, abs=1)
    assert fast.index("░") == slow.index("░")


def test_only_the_newest_recoveries_are_shown_individually() -> None:
    found = printed(*fleet.recoveries(), last=1)
    assert [line[:2] for line in found if line.startswith("#")] == ["#3", "#2", "#1", "#3"]


@pytest.mark.parametrize("columns", [60, 80, 140])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    assert max(map(len, printed(*fleet.recoveries(), columns=columns))) <= columns


def test_a_failed_recovery_is_shown() -> None:
    tried = [Attempt(strategy="Restart", pod="robot-17-abc", result="NotVerified", message="not verified within 60 s")]
    failed = fleet.recovery(
        4, 100, result="Failed", strategy="", recovery_seconds=None, parts=(0.5, 60.0, 0.0, 0.0), attempts=tried, new=""
    )
    found = printed(failed)
    assert found[2].endswith("FAILED: no strategy was verified")
    assert not any(line.startswith("    control") for line in found)
    assert_golden("command_line", row(found, "failed"), "Restart with robot-17-abc", "60 s")


def test_planned_and_resumed_recoveries_are_marked() -> None:
    assert "planned switchover in 509 ms" in printed(fleet.recovery(1, 5, planned=True))[2]
    assert "the monitor restarted" in row(printed(fleet.recovery(1, 5, resumed=True)), "resumed")


def test_a_recovery_without_parts_and_moments_is_shown() -> None:
    bare = Recovery(id="r", reason="pod a is gone", result="Failed", moments=Moments())
    assert printed(bare, bare, columns=None)[0] == "fleet/robot-17: 2 recoveries"


def test_no_recovery_is_shown_before_the_first_one() -> None:
    assert printed() == ["fleet/robot-17: no recoveries yet"]
