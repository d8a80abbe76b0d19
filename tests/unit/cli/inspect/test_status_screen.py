"""Robots on one screen, however wide that is."""

from __future__ import annotations

import dataclasses
import re

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from understudy.cli.common.robots import pool, robot
from understudy.cli.inspect.status_screen import Layout, in_a_line, lines, screenful, summary

ALL = [fleet.well(), fleet.degraded(), fleet.unprotected(), fleet.unwatched()]
ROBOTS = [robot(item) for item in ALL]
POOLS = [pool(fleet.short_of_one()), pool(fleet.short_of_another())]
LOOK = Layout(now=fleet.NOW)


def screen_lines(columns: int | None, **look: bool) -> list[str]:
    return list(lines(ROBOTS, POOLS, dataclasses.replace(LOOK, columns=columns, **look)))


def test_active_instance_protection_and_last_recovery_are_shown() -> None:
    head, first, *_ = screen_lines(140)
    assert head.split("  ")[0] == "ROBOT"
    assert re.split(r"\s{2,}", first) == [
        "robot-17-navigation", "Healthy", "yes", "robot-17-navigation-x8v2m (41)", "Executing (1/1)",
        "509 ms by Fallback/Executing, 4m12s ago",
    ]  # fmt: skip


def test_a_problem_is_shown_below_its_robot_with_its_duration() -> None:
    found = screen_lines(140)
    index = next(i for i, line in enumerate(found) if line.startswith("robot-19-navigation"))
    assert "  NO  " in found[index]
    assert_golden("status", found[index + 1], "(ImagePullBackOff, 3m12s)", "robot-19-navigation-w7h5k")


@pytest.mark.parametrize("columns", [40, 60, 80, 100, 120, 140])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    assert max(map(len, screen_lines(columns))) <= columns


def test_a_narrow_terminal_shows_the_same_robots() -> None:
    for columns in (40, 80, 140):
        text = " ".join(" ".join(screen_lines(columns)).split())
        assert text.count("not protected (") == 2
        assert "…-x8v2m (41)" in text or "robot-17-navigation-x8v2m (41)" in text


def test_without_a_width_a_problem_is_one_line() -> None:
    (problem,) = (line for line in screen_lines(None) if "(ImagePullBackOff" in line)
    assert_golden("status", problem, "imagePullSecrets", "pool navigation-spare", "ready (Uninitialized)")


def test_a_pool_does_not_repeat_the_problem_of_a_robot() -> None:
    found = screen_lines(None)
    assert sum("ImagePullBackOff: manifest unknown" in line for line in found) == 1
    assert "  not ready (PodsNotReady, 4s): 3 of 4 are ready." in found
    alone = list(lines([robot(fleet.well())], POOLS, LOOK))
    assert any("2 of 3 are ready; pod robot-19-navigation-w7h5k" in line for line in alone)


def test_robots_with_problems_come_first_if_the_screen_is_too_small() -> None:
    look = dataclasses.replace(LOOK, columns=140)
    everything = screen_lines(140)
    assert screenful(ROBOTS, POOLS, look, len(everything)) == everything
    found = screenful(ROBOTS, POOLS, look, 10)
    assert len(found) == 10
    assert_golden("status", found[0], "4 robots", "2 not protected", "1 degraded", "2 healthy", "1 unwatched")
    assert found[3].startswith("robot-19-navigation")
    assert found[-1] == f"… {len(everything) - 9} more lines: enlarge the window, or name robots"


def test_columns_keep_their_place_when_a_health_changes() -> None:
    name = "robot-17-navigation"
    for columns in (80, 100, 140):
        look = dataclasses.replace(LOOK, columns=columns)
        heads = {
            next(
                iter(
                    lines(
                        [robot(fleet.workload(name, status=fleet.status(name, "x8v2m", 41, health=health)))], [], look
                    )
                )
            )
            for health in ("Healthy", "Recovering", "Failed")
        }
        assert len(heads) == 1


def test_colours_do_not_change_text_or_alignment() -> None:
    coloured = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in screen_lines(140, colours=True)]
    assert coloured == screen_lines(140)
    assert any("\x1b[1;31mNO" in line for line in screen_lines(140, colours=True))


def test_wide_output_has_more_columns_and_is_not_shortened() -> None:
    head = screen_lines(40, wide=True)[0]
    assert head.split()[-5:] == ["NEXT", "SITUATION", "POLICY", "GATE", "AGE"]


def test_namespaces_are_shown_if_all_are_selected() -> None:
    assert screen_lines(None, namespaces=True)[1].startswith("fleet      robot-17-navigation")
    assert screen_lines(40, namespaces=True)[0].startswith("fleet/robot-17-navigation")


def test_a_robot_without_active_instance_and_with_failed_recovery_is_shown() -> None:
    name = "robot-1"
    failed = fleet.recovery(1, 60, result="Failed", recovery_seconds=None, strategy="")
    status = fleet.status(name, "", 4, health="Failed", recoveries=[failed], recovery_count=1)
    found = list(lines([robot(fleet.workload(name, status=status))], [], LOOK))
    assert "none (4)" in found[1]
    assert "FAILED, 59s ago" in found[1]


def test_a_recovery_known_only_from_the_gate_is_shown() -> None:
    item = fleet.well()
    found = robot(item, fleet.gate(item, fleet.under_way()), fleet.NOW)
    _, first, second, *_ = lines([found], [], LOOK)
    assert re.split(r"\s{2,}", first)[1:4] == ["Recovering", "yes", "robot-17-navigation-w7h5k (42)"]
    assert_golden("status", second, "(FailureDetected, 1s)", "/cmd_vel", "500 ms", "robot-17-navigation-w7h5k")
    for columns in (40, 80):
        printed = list(lines([found], [], dataclasses.replace(LOOK, columns=columns)))
        assert max(map(len, printed)) <= columns
        assert "Fallback/Executing is tried" in " ".join(" ".join(printed).split())
    assert_golden("status", in_a_line(found), "FailureDetected", "/cmd_vel", "500 ms", "robot-17-navigation-w7h5k")


def test_control_characters_are_escaped() -> None:
    bad = fleet.condition("Protected", "False", "PoolEmpty", "a\x1b[2Jb\nc")
    status = fleet.status("robot-1", "abcde", 1, bad)
    shown = robot(fleet.workload("robot-1", status=status))
    for text in [*lines([shown], [], LOOK), in_a_line(shown)]:
        assert not set("\x1b\n") & set(text)


def test_the_fleet_is_summarized_in_one_line() -> None:
    assert_golden("status", summary(ROBOTS), "4 robots", "2 not protected", "1 degraded", "2 healthy", "1 unwatched")
    assert summary(ROBOTS[:1]) == "1 robot: all protected; 1 healthy"


def test_the_line_of_a_robot_contains_no_elapsed_time() -> None:
    found = in_a_line(ROBOTS[2])
    assert_golden(
        "status",
        found,
        "fleet/robot-19-navigation; Healthy; NOT PROTECTED",
        "robot-19-navigation-c5n8r (epoch 7)",
        "Executing (0/1)",
        "ImagePullBackOff",
    )
    assert "last recovery #3 509 ms by Fallback/Executing" in in_a_line(ROBOTS[0])
    assert "ago" not in in_a_line(ROBOTS[0])
