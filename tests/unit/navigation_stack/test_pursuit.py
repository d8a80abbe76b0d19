from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from navigation_stack.poses import Pose
from navigation_stack.pursuit import Command, Limits, Pursuit

from tests.unit.navigation_stack.drives import PERIOD, arc

NOTHING = np.empty((0, 2), np.float32)
STRAIGHT = [Pose(0.05 * n, 0.0, 0.0) for n in range(61)]


def driven(pursuit: Pursuit, pose: Pose, seconds: float = 30.0) -> tuple[Pose, list[Command]]:
    commands: list[Command] = []
    for _ in range(int(seconds / PERIOD)):
        commands.append(pursuit.command(pose, NOTHING, PERIOD))
        if commands[-1].reached:
            break
        pose = pose.then(arc(commands[-1].linear * PERIOD, commands[-1].angular * PERIOD))
    return pose, commands


@pytest.mark.parametrize("heading", [0.0, 1.0, math.pi, -2.0])
def test_the_robot_reaches_the_goal_and_its_heading_from_any_initial_heading(heading: float) -> None:
    pursuit = Pursuit()
    pursuit.follow([*STRAIGHT[:-1], Pose(3.0, 0.0, 2.0)])
    end, commands = driven(pursuit, Pose(0.0, 0.05, heading))
    assert commands[-1].reached
    assert end.distance(Pose(3.0, 0.0, 0.0)) <= pursuit.limits.xy_goal_tolerance + 0.03
    assert end.heading == pytest.approx(2.0, abs=pursuit.limits.yaw_goal_tolerance)
    assert commands[-1] == Command(reached=True)


def test_commands_stay_within_the_limits_of_the_robot() -> None:
    limits = Limits()
    pursuit = Pursuit(limits)
    pursuit.follow([*STRAIGHT, *(Pose(3.0, 0.05 * n, math.pi / 2) for n in range(1, 40))])
    _, commands = driven(pursuit, Pose(0.0, 0.0, 0.0))
    assert all(0 <= c.linear <= limits.desired_linear_vel and abs(c.angular) <= 1.5 for c in commands)
    faster = [b.linear - a.linear for a, b in itertools.pairwise(commands)]
    assert max(faster) <= limits.max_linear_accel * PERIOD + 1e-9


def test_a_new_path_to_the_same_goal_does_not_reduce_the_speed() -> None:
    pursuit = Pursuit()
    pursuit.follow(STRAIGHT)
    pose = Pose(0.0, 0.0, 0.0)
    for _ in range(20):
        command = pursuit.command(pose, NOTHING, PERIOD)
        pose = pose.then(arc(command.linear * PERIOD, command.angular * PERIOD))
    pursuit.follow([p for p in STRAIGHT if p.x > pose.x])
    assert pursuit.command(pose, NOTHING, PERIOD).linear == pytest.approx(command.linear, abs=0.06)


def test_the_robot_stops_before_an_obstacle_and_continues_when_it_is_removed() -> None:
    pursuit = Pursuit()
    pursuit.follow(STRAIGHT)
    pose = Pose(0.0, 0.0, 0.0)
    for _ in range(400):
        # A wall across the way, 1.5 m from where it began.
        ahead = 1.5 - pose.x
        wall = np.array([[ahead, y] for y in np.linspace(-0.5, 0.5, 41)], np.float32)
        command = pursuit.command(pose, wall, PERIOD)
        pose = pose.then(arc(command.linear * PERIOD, command.angular * PERIOD))
        if command.blocked:
            break
    assert command == Command(blocked=True)
    assert 0.5 < pose.x < 1.5 - 0.18
    assert pursuit.command(pose, NOTHING, PERIOD).linear > 0


def test_a_wall_at_the_side_of_the_robot_does_not_stop_it() -> None:
    pursuit = Pursuit()
    pursuit.follow(STRAIGHT)
    wall = np.array([[x, 0.25] for x in np.linspace(-2, 2, 81)], np.float32)
    assert pursuit.command(Pose(0.0, 0.0, 0.0), wall, PERIOD).linear > 0


def test_an_obstacle_behind_the_robot_does_not_stop_it() -> None:
    pursuit = Pursuit()
    pursuit.follow(STRAIGHT)
    behind = np.array([[-0.15, 0.0], [-0.1, 0.1]], np.float32)
    assert pursuit.command(Pose(0.0, 0.0, 0.0), behind, PERIOD).linear > 0


def test_the_remaining_distance_shrinks() -> None:
    pursuit = Pursuit()
    pursuit.follow(STRAIGHT)
    assert pursuit.left == pytest.approx(3.0)
    pursuit.command(Pose(0.9, 0.0, 0.0), NOTHING, PERIOD)
    assert pursuit.left == pytest.approx(2.1)


def test_an_empty_path_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one pose"):
        Pursuit().follow([])
