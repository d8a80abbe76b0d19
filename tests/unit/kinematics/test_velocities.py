"""Velocities out of poses: right where the motion is known, and as uncertain as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.kinematics.velocities import Position, Velocities, Velocity

SIGMA = 0.001, 0.002, 0.004


def position(stamp: float, x: float, y: float, heading: float, sigma: tuple[float, float, float] = SIGMA) -> Position:
    return Position(stamp, x, y, heading, (sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2))


def driven(speed: float, turn: float, start: float = 0.0, count: int = 6, period: float = 0.1) -> list[Position]:
    """Poses of a robot that drives evenly on a circle, or straight."""
    poses = []
    for index in range(count):
        t = index * period
        heading = start + turn * t
        chord = speed * t * (math.sin(turn * t / 2) / (turn * t / 2) if turn * t else 1.0)
        along = start + turn * t / 2
        poses.append(
            position(100.0 + t, chord * math.cos(along), chord * math.sin(along), math.remainder(heading, math.tau))
        )
    return poses


def last(velocities: Velocities, poses: list[Position]) -> Velocity | None:
    found = None
    for pose in poses:
        found = velocities.add(pose)
    return found


@given(
    speed=st.floats(-1, 1),
    turn=st.floats(-1, 1),
    start=st.floats(-math.pi, math.pi),
)
def test_constant_motion_is_measured_in_the_robot_frame(speed: float, turn: float, start: float):
    found = last(Velocities(0.5), driven(speed, turn, start))
    assert found is not None
    # A line through a part of a circle is shorter than it: by 1 % at 1 rad/s and half a second.
    assert found.forward == pytest.approx(speed, abs=1e-6 + 0.011 * abs(speed))
    assert found.left == pytest.approx(0.0, abs=1e-6 + 0.02 * abs(speed * turn))
    assert found.turn == pytest.approx(turn, abs=1e-6)


def test_a_heading_that_passes_180_degrees_causes_no_jump():
    found = last(Velocities(0.5), driven(0.2, 0.8, math.pi - 0.1))
    assert found is not None
    assert found.turn == pytest.approx(0.8)


def test_the_reported_uncertainty_is_correct():
    random = np.random.default_rng(1)
    errors, stated = [], []
    for _ in range(2000):
        poses = [
            pose._replace(x=pose.x + dx, y=pose.y + dy, heading=pose.heading + dh)
            for pose, (dx, dy, dh) in zip(driven(0.3, 0.0, 0.7), random.normal(0, SIGMA, (6, 3)), strict=True)
        ]
        found = last(Velocities(0.5), poses)
        assert found is not None
        errors.append((found.forward - 0.3, found.left, found.turn))
        stated.append((found.covariance[0][0], found.covariance[1][1], found.turn_variance))
    # It is never said to be less than the poses' own, and more where chance makes them lie badly.
    ratio = np.sqrt(np.mean(stated, axis=0)) / np.std(errors, axis=0)
    assert (ratio > 0.95).all()
    assert (ratio < 1.4).all()


def test_the_uncertainty_is_larger_while_the_speed_changes():
    even = last(Velocities(0.5), driven(0.3, 0.0))
    braking = driven(0.3, 0.0)
    braking[3:] = [pose._replace(x=braking[2].x) for pose in braking[3:]]
    stopped = last(Velocities(0.5), braking)
    assert even is not None
    assert stopped is not None
    assert 0.0 < stopped.forward < 0.3
    assert stopped.covariance[0][0] > 10 * even.covariance[0][0]


def test_too_few_poses_give_no_velocity():
    velocities, poses = Velocities(0.5), driven(0.3, 0.0, count=12)
    assert [velocities.add(pose) is not None for pose in poses[:4]] == [False, False, False, True]
    # The robot was out of sight for longer than the window: the estimate starts again.
    later = [pose._replace(stamp=pose.stamp + 5) for pose in poses]
    assert [velocities.add(pose) is not None for pose in later[:4]] == [False, False, False, True]


def test_a_clock_that_goes_back_starts_the_estimate_again():
    velocities = Velocities(0.5)
    last(velocities, driven(0.3, 0.0))
    again = [pose._replace(stamp=pose.stamp - 50) for pose in driven(-0.3, 0.0)]
    assert velocities.add(again[0]) is None
    found = last(velocities, again[1:])
    assert found is not None
    assert found.forward == pytest.approx(-0.3)


@settings(max_examples=50)
@given(stamps=st.lists(st.floats(0, 1e9), max_size=30), value=st.floats(-1e4, 1e4))
def test_any_stamps_give_finite_numbers_or_nothing(stamps: list[float], value: float):
    velocities = Velocities(0.5)
    for stamp in stamps:
        found = velocities.add(position(stamp, value, -value, value))
        if found is not None:
            assert all(map(math.isfinite, (found.forward, found.left, found.turn, found.turn_variance)))
            assert found.covariance[0][0] > 0
