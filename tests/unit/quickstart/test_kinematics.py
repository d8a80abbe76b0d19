from __future__ import annotations

import math

import pytest
from understudy_quickstart.kinematics import Base, Limits, Pose, approached, moved, wrapped


def run(base: Base, start: float, seconds: float, *, period: float = 0.02) -> float:
    """Step the base in free space; the time after it."""
    now = start
    for _ in range(round(seconds / period)):
        now += period
        base.place(base.step(now))
    return now


def test_a_robot_without_rotation_moves_straight() -> None:
    pose = moved(Pose(1.0, 2.0, math.pi / 2), 0.5, 0.0, 2.0)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 3.0, math.pi / 2))


def test_an_arc_ends_at_the_geometric_position() -> None:
    # A quarter of a circle of radius 1 to the left.
    pose = moved(Pose(0.0, 0.0, 0.0), 0.5, 0.5, math.pi)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_slight_arc_approximates_a_straight_line() -> None:
    arc, line = moved(Pose(0, 0, 0.3), 0.5, 2e-6, 1.0), moved(Pose(0, 0, 0.3), 0.5, 0.0, 1.0)
    assert (arc.x, arc.y) == pytest.approx((line.x, line.y), abs=1e-5)


@pytest.mark.parametrize(
    ("angle", "same"),
    [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (3.5, 3.5 - math.tau), (7.0, 7.0 - math.tau)],
)
def test_angles_are_wrapped(angle: float, same: float) -> None:
    assert wrapped(angle) == pytest.approx(same)


@pytest.mark.parametrize(
    ("value", "target", "after"),
    [
        (0.0, 1.0, 0.1),
        (0.95, 1.0, 1.0),
        (0.0, -1.0, -0.1),
        (1.0, 0.0, 0.8),
        (0.1, 0.0, 0.0),
        (-1.0, 0.0, -0.8),
        (0.1, -1.0, 0.0),
        (-0.1, 1.0, 0.0),
        (-0.5, -1.0, -0.6),
        (-1.0, -0.9, -0.9),
        (0.3, 0.3, 0.3),
    ],
)
def test_speeds_approach_their_targets_within_the_limits(value: float, target: float, after: float) -> None:
    assert approached(value, target, up=0.1, down=0.2) == pytest.approx(after)


def test_motion_follows_commands_within_the_limits_of_the_motors() -> None:
    base = Base(Pose(0, 0, 0), now=10.0, limits=Limits(acceleration=0.5, speed=0.6), watchdog=10.0)
    base.command(2.0, 0.0, now=10.0)
    now = run(base, 10.0, 1.0)
    assert base.speed == pytest.approx(0.5)
    run(base, now, 1.0)
    assert base.speed == pytest.approx(0.6), "cut down to what the motors can do"
    assert base.pose.x == pytest.approx(0.25 + 0.11 + 0.6 * 0.8, abs=0.02)


def test_the_base_stops_when_commands_end() -> None:
    base = Base(Pose(0, 0, 0), now=0.0, watchdog=0.5)
    base.command(0.5, 0.4, now=0.0)
    now = run(base, 0.0, 0.48)
    assert base.speed > 0.3
    assert not base.held(now)
    now = run(base, now, 1.0)
    assert base.held(now)
    assert (base.speed, base.turn) == (0.0, 0.0)
    base.command(0.5, 0.0, now=now)
    run(base, now, 0.4)
    assert base.speed > 0.3


def test_a_base_without_a_command_stays_at_its_place() -> None:
    base = Base(Pose(0, 0, 0), now=0.0)
    assert base.held(0.0)
    run(base, 0.0, 1.0)
    assert base.pose == Pose(0, 0, 0)


def test_a_late_step_covers_the_whole_time() -> None:
    steady, stalled = (Base(Pose(0, 0, 0), now=0.0, watchdog=60.0) for _ in range(2))
    for base in (steady, stalled):
        base.command(0.5, 0.0, now=0.0)
    run(steady, run(steady, 0.0, 1.0), 1.0)
    run(stalled, run(stalled, 0.0, 1.0), 1.0, period=1.0)
    assert stalled.pose.x == pytest.approx(steady.pose.x)
