"""Ways round what is in the way, and how fast they are gone."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("ompl")

from manipulation_arm import HOME, Arm, Joints, places
from manipulation_stack.motion import ACCELERATION, SPEED, Motion
from manipulation_stack.planning import RESOLUTION, NoWay, dense, plan

PERIOD = 0.02


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm()


def gone(motion: Motion) -> list[Joints]:
    commands = []
    while not motion.arrived:
        commands.append(motion.advance(PERIOD).positions)
        assert len(commands) < 5000
    return commands


def test_paths_avoid_obstacles(arm: Arm) -> None:
    goals = [arm.solve(pose) for pose in places(6)]
    for start, goal in zip([HOME, *goals], goals, strict=False):
        assert start is not None
        assert goal is not None
        way = plan(arm, start, goal)
        assert way[0] == pytest.approx(start)
        assert way[-1] == pytest.approx(goal)
        assert np.abs(np.diff(way, axis=0)).max() <= RESOLUTION + 1e-9
        assert all(arm.free(joints) for joints in way)


def test_a_path_without_obstacles_is_straight(arm: Arm) -> None:
    goal = HOME + np.array((0.3, 0.1, 0.0, 0.0, 0.0, 0.0))
    way = plan(arm, HOME, goal)
    assert way == pytest.approx(dense(np.stack([HOME, goal])))


def test_a_goal_inside_an_obstacle_has_no_path(arm: Arm) -> None:
    with pytest.raises(NoWay):
        plan(arm, HOME, np.array((0.0, 1.2, 0.5, 0.0, 0.5, 0.0)))


def test_commands_stay_within_the_speed_limit_and_end_at_the_goal(arm: Arm) -> None:
    goal = arm.solve(next(places(1)))
    assert goal is not None
    commands = gone(Motion(plan(arm, HOME, goal)))
    steps = np.abs(np.diff([HOME, *commands], axis=0)).max(axis=1)
    assert steps.max() <= SPEED * PERIOD + 1e-9
    assert np.abs(np.diff(steps)).max() <= 3 * ACCELERATION * PERIOD**2
    assert commands[-1] == pytest.approx(goal)


def test_a_motion_slows_down_at_a_corner() -> None:
    corner = np.zeros((3, 6))
    corner[1, 0] = corner[2, 0] = 1.0
    corner[2, 1] = 1.0
    motion = Motion(dense(corner))
    speeds = []
    while not motion.arrived:
        command = motion.advance(PERIOD)
        speeds.append((command.positions[0] + command.positions[1], np.abs(command.velocities).max()))
    assert max(speed for place, speed in speeds if 0.4 < place < 0.6) == pytest.approx(SPEED)
    assert min(speed for place, speed in speeds if 0.98 < place < 1.02) < SPEED / 2


def test_a_motion_of_zero_length_ends_at_once() -> None:
    motion = Motion(np.repeat(HOME[None], 2, axis=0))
    assert motion.advance(PERIOD).positions == pytest.approx(HOME)
    assert motion.arrived
