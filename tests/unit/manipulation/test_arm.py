"""The arm as its planner knows it, and as the simulation moves it."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("mujoco")

from manipulation_arm import HOME, Arm, Pose, places
from manipulation_arm.arm import ANGLE, PLACE
from manipulation_robot.controller import HELD, Controller
from manipulation_robot.simulation import Simulation
from manipulation_robot.trajectories import Trajectory

ALL = list(places(6))


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm()


def turned(one: Pose, other: Pose) -> float:
    """The angle between two orientations."""
    return 2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(one[3:], other[3:], strict=True)))))


def test_the_reach_of_the_arm_is_the_length_of_its_links(arm: Arm) -> None:
    stretched = arm.pose(np.array((0.0, math.pi / 2 - math.atan2(0.04975, 0.25), 0.0, 0.0, 0.0, 0.0)))
    # The shoulder's height, and the links one after the other.
    assert math.hypot(stretched.x, stretched.z - 0.11065) < math.hypot(0.04975, 0.25) + 0.175 + 0.075 + 0.065 + 0.0936
    assert arm.pose(np.zeros(6))[:3] == pytest.approx((0.04975 + 0.175 + 0.075 + 0.065 + 0.0936, 0.0, 0.36065))


@pytest.mark.parametrize("pose", ALL)
def test_the_arm_reaches_every_requested_pose(arm: Arm, pose: Pose) -> None:
    found = arm.solve(pose)
    assert found is not None
    assert arm.free(found)
    assert math.dist(arm.pose(found)[:3], pose[:3]) < PLACE
    assert turned(arm.pose(found), pose) < 2 * ANGLE


def test_every_instance_solves_a_pose_equally(arm: Arm) -> None:
    assert [Arm().solve(pose).tolist() for pose in ALL] == [arm.solve(pose).tolist() for pose in ALL]  # type: ignore[union-attr]


def test_an_unreachable_or_obstructed_pose_has_no_solution(arm: Arm) -> None:
    assert arm.solve(Pose(0.9, 0.0, 0.2)) is None
    assert arm.solve(Pose(0.33, 0.0, 0.1)) is None, "the post is there"
    assert arm.solve(Pose(0.9, 0.0, 0.2), over=lambda: True) is None


def test_positions_inside_the_table_or_beyond_joint_limits_are_not_free(arm: Arm) -> None:
    assert arm.free(HOME)
    assert not arm.free(np.array((0.0, 1.2, 0.5, 0.0, 0.5, 0.0)))
    assert not arm.free(HOME + np.array((4.0, 0, 0, 0, 0, 0))), "the waist doesn't turn so far"


def test_the_servos_hold_the_commanded_positions() -> None:
    simulation = Simulation()
    simulation.step(1000)
    assert simulation.positions == pytest.approx(HOME, abs=1e-3)
    simulation.drive(HOME + 0.1)
    simulation.step(1000)
    assert simulation.positions == pytest.approx(HOME + 0.1, abs=2e-3)
    assert np.abs(simulation.velocities).max() < 1e-2
    assert not simulation.touching


def test_the_reference_stops_when_commands_end() -> None:
    controller = Controller(HOME)
    assert controller.held(0.0)
    assert controller.command(HOME + 0.01, np.full(6, 0.5), now=1.0) == pytest.approx(0.01)
    assert not controller.held(0.99 + HELD)
    assert controller.velocities(0.99 + HELD) == pytest.approx(np.full(6, 0.5))
    assert controller.held(1.01 + HELD)
    assert controller.velocities(1.01 + HELD) == pytest.approx(np.zeros(6))
    assert controller.positions == pytest.approx(HOME + 0.01)


def test_a_stay_command_stops_the_reference_at_its_last_position() -> None:
    controller = Controller(HOME)
    controller.command(HOME + 0.01, np.full(6, 0.5), now=1.0)
    assert controller.stay(now=1.05) == 0.0
    assert controller.positions == pytest.approx(HOME + 0.01)
    assert controller.velocities(1.06) == pytest.approx(np.zeros(6))
    assert not controller.held(1.04 + HELD)


def test_a_trajectory_starts_at_the_position_of_the_arm_and_passes_its_points() -> None:
    trajectory = Trajectory(HOME, [1.0, 3.0], [HOME + 0.2, HOME - 0.2])
    assert trajectory.at(0.5) == pytest.approx(HOME + 0.1)
    assert trajectory.at(2.0) == pytest.approx(HOME)
    assert not trajectory.ended.is_set()
    assert trajectory.at(3.5) == pytest.approx(HOME - 0.2)
    assert trajectory.done


def test_a_trajectory_with_a_jump_or_invalid_times_is_refused() -> None:
    with pytest.raises(ValueError, match="from where the arm is"):
        Trajectory(HOME, [0.0, 1.0], [HOME + 0.2, HOME])
    for times in ([], [1.0, 1.0], [2.0, 1.0], [-1.0, 1.0]):
        with pytest.raises(ValueError, match="times"):
            Trajectory(HOME, times, [HOME] * len(times))


def test_a_trajectory_that_was_interrupted_is_not_done() -> None:
    trajectory = Trajectory(HOME, [1.0], [HOME])
    trajectory.end()
    trajectory.at(2.0)
    assert not trajectory.done
