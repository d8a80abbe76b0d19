from __future__ import annotations

import math

import numpy as np
import pytest
from navigation_stack.filter import ParticleFilter
from navigation_stack.grid import Grid
from navigation_stack.poses import Pose
from navigation_world import generate

from tests.unit.navigation_stack.drives import BEARINGS, as_pose, cast, charted

HERE = Pose(0.0, 0.0, 0.0)
NARROW = np.diag([1e-4, 1e-4, 1e-4]).tolist()


def room() -> Grid:
    cells = np.zeros((40, 60), np.int8)
    cells[[0, -1], :] = 100
    cells[:, [0, -1]] = 100
    return Grid(cells, 0.1, -1.0, -2.0)


def test_the_filter_starts_with_the_given_pose_and_covariance() -> None:
    particles = ParticleFilter(room(), particles=20_000, seed=1)
    wanted = [[0.04, 0.01, 0.0], [0.01, 0.02, 0.0], [0.0, 0.0, 0.01]]
    particles.spread(Pose(1.0, 0.5, 3.0), wanted)
    pose, covariance = particles.estimate()
    assert pose == pytest.approx((1.0, 0.5, 3.0), abs=0.01)
    assert covariance == pytest.approx(np.array(wanted), abs=2e-3)


def test_motion_is_applied_in_the_robot_frame_and_increases_the_spread() -> None:
    particles = ParticleFilter(room(), seed=1)
    particles.spread(Pose(1.0, 0.0, math.pi / 2), NARROW)
    before = particles.estimate()[1]
    for _ in range(10):
        particles.move(Pose(0.05, 0.0, 0.0))
    pose, covariance = particles.estimate()
    assert pose == pytest.approx((1.0, 0.5, math.pi / 2), abs=0.02)
    assert covariance[1, 1] > before[1, 1]


def test_a_scan_corrects_the_pose() -> None:
    world = generate(7)
    truth = as_pose(world.start)
    particles = ParticleFilter(charted(world), seed=1)
    particles.spread(truth.then(Pose(0.15, 0.15, 0.1)), np.diag([0.02, 0.02, 0.02]).tolist())
    scan = cast(world, truth)
    for _ in range(20):
        particles.move(HERE)
        particles.sense(scan, BEARINGS, HERE)
    pose, _ = particles.estimate()
    assert pose.distance(truth) < 0.05
    assert pose.heading == pytest.approx(truth.heading, abs=0.03)


def test_the_position_of_the_laser_on_the_robot_is_considered() -> None:
    world = generate(7)
    truth = as_pose(world.start)
    mount = Pose(0.1, 0.0, math.pi / 2)
    particles = ParticleFilter(charted(world), seed=1)
    particles.spread(truth, np.diag([0.01, 0.01, 0.01]).tolist())
    scan = cast(world, truth.then(mount))
    for _ in range(20):
        particles.move(HERE)
        particles.sense(scan, BEARINGS, mount)
    assert particles.estimate()[0].distance(truth) < 0.05


def test_a_pose_with_half_a_second_of_motion_error_is_corrected_at_any_place() -> None:
    """The error is what a robot drives in half a second; the covariance is that of a pose which the localization receives."""
    world = generate(7)
    grid, chance = charted(world), np.random.default_rng(3)
    lost = []
    for place in [world.start, *world.goals(15)]:
        truth = as_pose(place)
        particles, scan = ParticleFilter(grid, particles=500, seed=1), cast(world, truth)
        off = Pose(0.25, 0.0, 0.0), Pose(0.0, 0.0, chance.choice([-0.4, 0.4]))
        estimate = Pose(truth.x, truth.y, truth.heading + chance.uniform(-math.pi, math.pi)).then(off[0])
        estimate = Pose(estimate.x, estimate.y, truth.heading).then(off[1])
        particles.spread(estimate, np.diag(np.square([0.35, 0.35, 0.35])).tolist())
        for _ in range(15):
            particles.move(HERE)
            particles.sense(scan, BEARINGS, HERE)
        if particles.estimate()[0].distance(truth) > 0.15:
            lost.append(truth)
    assert not lost


def test_a_distant_wrong_pose_is_not_corrected() -> None:
    """There is no global search: this is why the pose has to be restored."""
    world = generate(7)
    truth, elsewhere = as_pose(world.start), as_pose(world.goals(1)[0])
    particles = ParticleFilter(charted(world), seed=1)
    particles.spread(elsewhere, NARROW)
    for _ in range(20):
        particles.move(HERE)
        particles.sense(cast(world, truth), BEARINGS, HERE)
    assert particles.estimate()[0].distance(truth) > 1.0


def test_a_scan_without_echoes_changes_nothing() -> None:
    particles = ParticleFilter(room(), seed=1)
    particles.spread(Pose(1.0, 0.5, 0.0), NARROW)
    before = particles.estimate()[0]
    particles.sense(np.full(360, np.inf, np.float32), np.linspace(0, 6, 360, dtype=np.float32), HERE)
    assert particles.estimate()[0] == before


def test_a_pose_outside_the_map_is_accepted() -> None:
    particles = ParticleFilter(room(), seed=1)
    particles.spread(Pose(100.0, -50.0, 0.0), NARROW)
    particles.sense(np.full(360, 2.0, np.float32), np.linspace(0, 6, 360, dtype=np.float32), HERE)
    assert particles.estimate()[0].x == pytest.approx(100.0, abs=0.5)


@pytest.mark.parametrize("covariance", [[[1.0, 0.0], [0.0, 1.0]], np.full((3, 3), np.nan).tolist()])
def test_an_invalid_covariance_is_refused(covariance: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="covariance: a finite 3 by 3 matrix"):
        ParticleFilter(room()).spread(HERE, covariance)
