"""Poses are joined as rigid bodies move, and what is doubted of them grows as it does for one."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.kinematics.poses import DRIFT, DRIFT_IN_HEADING, HERE, ROUNDING, Pose, carried, grown

PLACES = st.floats(-100.0, 100.0)
PARTS = st.floats(-1.0, 1.0)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    turn = [draw(PARTS) for _ in range(4)]
    length = math.hypot(*turn)
    turn = [value / length for value in turn] if length > 0.01 else [0.0, 0.0, 0.0, 1.0]
    return Pose.of([draw(PLACES), draw(PLACES), draw(PLACES), *turn])


def planar(x: float, y: float, heading: float) -> Pose:
    return Pose(x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def heading(pose: Pose) -> float:
    return math.remainder(2 * math.atan2(pose.qz, pose.qw), math.tau)


def same(a: Pose, b: Pose, tolerance: float = 1e-6) -> bool:
    return a.distance(b) < tolerance and a.to(b).angle < tolerance


def driven(pose: Pose, speed: float, turn: float, seconds: float, steps: int = 400) -> Pose:
    """Where a robot comes to that drives evenly, in exact arcs."""
    for _ in range(steps):
        t = seconds / steps
        half = turn * t / 2
        chord = speed * t * (math.sin(half) / half if half else 1.0)
        pose = pose.then(planar(chord * math.cos(half), chord * math.sin(half), turn * t))
    return pose


@settings(deadline=None, max_examples=60)
@given(poses(), poses(), poses())
def test_poses_form_a_group_under_composition(a: Pose, b: Pose, c: Pose) -> None:
    assert same(a.then(a.inverse()), HERE)
    assert same(a.inverse().then(a), HERE)
    assert same(a.then(b).then(c), a.then(b.then(c)))
    assert same(a.then(a.to(b)), b)


@settings(deadline=None, max_examples=60)
@given(poses(), poses(), poses(), poses())
def test_the_origin_of_odometry_has_no_influence(kept: Pose, then: Pose, now: Pose, origin: Pose) -> None:
    assert same(carried(kept, then, now), carried(kept, origin.then(then), origin.then(now)))


@settings(deadline=None, max_examples=60)
@given(poses(), poses(), poses())
def test_a_pose_propagated_in_its_own_frame_equals_the_pose_in_that_frame(origin: Pose, then: Pose, now: Pose) -> None:
    """Where the map and odometry only differ by a transform that doesn't change, the map's present pose is known exactly."""
    assert same(carried(origin.then(then), then, now), origin.then(now))


@settings(deadline=None, max_examples=60)
@given(poses(), poses(), st.floats(0.0, 1.0))
def test_interpolation_reaches_both_poses(a: Pose, b: Pose, part: float) -> None:
    between = a.towards(b, part)
    assert same(a.towards(b, 0.0), a)
    assert same(a.towards(b, 1.0), b)
    assert a.distance(between) == pytest.approx(part * a.distance(b), abs=1e-6)
    assert a.to(between).angle == pytest.approx(part * a.to(b).angle, abs=1e-6)
    assert math.hypot(*between[3:]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("speed", "turn", "seconds", "to"),
    [
        pytest.param(0.5, 0.0, 1.0, (10.0, 20.5, math.pi / 2), id="straight"),
        pytest.param(-0.5, 0.0, 2.0, (10.0, 19.0, math.pi / 2), id="backwards"),
        pytest.param(0.0, 1.0, math.pi / 2, (10.0, 20.0, math.pi), id="on the spot"),
        pytest.param(0.5, 0.5, math.pi, (9.0, 21.0, math.pi), id="a quarter to the left"),
        pytest.param(0.5, -0.5, math.pi, (11.0, 21.0, 0.0), id="a quarter to the right"),
        pytest.param(0.5, 0.5, 4 * math.pi, (10.0, 20.0, math.pi / 2), id="a full circle"),
    ],
)
def test_a_pose_on_the_map_moves_as_the_robot_drives(
    speed: float, turn: float, seconds: float, to: tuple[float, float, float]
) -> None:
    """The robot stands at (10, 20) and looks along the map's y; odometry believes it elsewhere, and looking elsewhere."""
    then = planar(-3.0, 1.0, 2.5)
    reached = carried(planar(10.0, 20.0, math.pi / 2), then, driven(then, speed, turn, seconds))
    assert reached.place == pytest.approx((*to[:2], 0.0), abs=1e-6)
    assert math.remainder(heading(reached) - to[2], math.tau) == pytest.approx(0.0, abs=1e-6)


def test_a_rotation_is_about_its_axis() -> None:
    """A quarter about z takes x to y; then a quarter about the body's own x takes its y up."""
    quarter = math.sqrt(0.5)
    about_z, about_x = Pose(0, 0, 0, 0, 0, quarter, quarter), Pose(0, 0, 0, quarter, 0, 0, quarter)
    assert about_z.turned((1, 0, 0)) == pytest.approx((0, 1, 0))
    assert about_z.then(about_x).turned((0, 1, 0)) == pytest.approx((0, 0, 1))
    assert about_x.then(about_z).turned((1, 0, 0)) == pytest.approx((0, 0, 1))


def test_a_quaternion_and_its_negative_are_the_same_rotation() -> None:
    a, b = planar(1.0, 2.0, 0.4), planar(2.0, 2.0, 0.6)
    negative = Pose(b.x, b.y, b.z, -b.qx, -b.qy, -b.qz, -b.qw)
    assert same(a.towards(negative, 0.5), a.towards(b, 0.5))
    assert same(carried(a, a, negative), carried(a, a, b))


def test_many_steps_stay_a_rotation() -> None:
    pose, step = HERE, planar(0.01, 0.0, 0.003)._replace(qx=1e-4)
    step = Pose.of(step)
    for _ in range(20_000):
        pose = pose.then(step)
    assert math.hypot(*pose[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        [0.0] * 7,
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5],
        [math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        [0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, 0.0, 1.0],
    ],
)
def test_an_invalid_pose_is_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match=r"is not a (pose|rotation)"):
        Pose.of(values)


# -- covariance -----------------------------------------------------------------------------------------------------


def diagonal(*values: float) -> list[float]:
    return [values[i] if i == j else 0.0 for i in range(6) for j in range(6)]


def test_uncertainty_of_the_heading_becomes_lateral_uncertainty() -> None:
    """After 2 m along x, 0.1 rad are 0.2 m in y; the rest is what odometry is doubted by."""
    before = diagonal(0.04, 0.04, 0, 0, 0, 0.01)
    after = grown(before, planar(0, 0, 0), planar(2, 0, 0), driven=2.0, turned=0.0)
    place, turn = (DRIFT * 2) ** 2, (DRIFT_IN_HEADING * 2) ** 2
    assert after[0] == pytest.approx(0.04 + place)
    assert after[7] == pytest.approx(0.04 + place + 2**2 * 0.01)
    assert after[7 * 5] == pytest.approx(0.01 + turn)
    assert after[6 + 5] == after[30 + 1] == pytest.approx(2 * 0.01)
    assert [after[7 * i] for i in (2, 3, 4)] == [0.0, 0.0, 0.0], "a planar robot doesn't begin to fly"


def test_the_covariance_equals_that_of_propagated_samples() -> None:
    """Monte Carlo: poses drawn from the covariance, each carried, against the covariance that is reckoned."""
    chance = random.Random(4)
    sigma = (0.1, 0.2, 0.15, 0.02, 0.03, 0.05)
    kept = Pose.of([1.0, 2.0, 3.0, 0.1, 0.2, math.sqrt(1 - 0.05 - 0.25), 0.5])
    then, now = planar(5.0, 5.0, 1.0), planar(7.0, 6.0, 2.0)
    reached = carried(kept, then, now)
    drawn = []
    for _ in range(4000):
        dx, dy, dz, rx, ry, rz = (chance.gauss(0.0, s) for s in sigma)
        turn = Pose.of([0, 0, 0, rx / 2, ry / 2, rz / 2, math.sqrt(1 - (rx**2 + ry**2 + rz**2) / 4)])
        start = turn.then(kept._replace(x=0, y=0, z=0))._replace(x=kept.x + dx, y=kept.y + dy, z=kept.z + dz)
        drawn.append([a - b for a, b in zip(carried(start, then, now).place, reached.place, strict=True)])
    reckoned = grown(diagonal(*(s**2 for s in sigma)), kept, reached, driven=0.0, turned=0.0)
    for i in range(3):
        for j in range(3):
            found = sum(d[i] * d[j] for d in drawn) / len(drawn)
            assert found == pytest.approx(reckoned[6 * i + j], rel=0.15, abs=0.002)


def test_a_variance_below_zero_by_rounding_becomes_a_small_one() -> None:
    """Nav2's AMCL publishes such ones while the robot stands, and computes NaN of them as an initial pose."""
    rounded = diagonal(-1.1e-11, 0, 0, 0, 0, 3.2e-14)
    rounded[1] = rounded[6] = 2e-12
    after = grown(rounded, HERE, HERE, driven=0.0, turned=0.0)
    assert [after[0], after[7], after[35]] == [ROUNDING] * 3
    assert [value for i, value in enumerate(after) if i not in (0, 7, 35)] == [0.0] * 33


def test_an_unknown_covariance_stays_unknown() -> None:
    unknown = [-1.0, *[0.0] * 35]
    assert grown(unknown, HERE, planar(1, 0, 0), driven=1.0, turned=0.0) == unknown


@settings(deadline=None, max_examples=40)
@given(poses(), poses(), st.floats(0, 50), st.floats(0, 10))
def test_the_covariance_never_shrinks_and_stays_symmetric(a: Pose, b: Pose, metres: float, radians: float) -> None:
    before = diagonal(0.1, 0.1, 0.1, 0.01, 0.01, 0.01)
    after = grown(before, a, b, driven=metres, turned=radians)
    for i in range(6):
        assert after[7 * i] >= before[7 * i]
        for j in range(6):
            assert after[6 * i + j] == pytest.approx(after[6 * j + i])
