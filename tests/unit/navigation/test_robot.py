"""The robot's base, wheels and laser, in simulated time."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("mujoco")

from navigation_robot.base import Base, Limits
from navigation_robot.odometry import Odometry
from navigation_robot.simulation import FARTHEST, NEAREST, Simulation
from navigation_world import OCCUPIED, ROBOT_RADIUS, Pose, World, generate

TICK = 0.02


@pytest.fixture(scope="module")
def world() -> World:
    return generate(7)


def corridor(world: World) -> Pose:
    """In the middle of the corridor, looking along it, with some metres of space ahead."""
    place = world.rooms[0]
    y = (place.bottom + place.top) / 2
    for x in np.arange(place.left + 0.5, place.right - 3.5, 0.1):
        ahead = np.arange(x, x + 3.0, 0.05)
        if world.clearance(ahead, np.full_like(ahead, y)).min() > ROBOT_RADIUS + 0.1:
            return Pose(float(x), y, 0.0)
    raise AssertionError("the corridor is blocked")


def go(simulation: Simulation, speed: float, turn: float, seconds: float, odometry: Odometry | None = None) -> None:
    for _ in range(round(seconds / TICK)):
        simulation.drive(speed, turn)
        simulation.step(round(TICK / simulation.timestep))
        if odometry is not None:
            odometry.update(*simulation.wheels, TICK)


def test_the_robot_starts_at_the_pose_of_the_world_and_stays_there(world: World) -> None:
    simulation = Simulation(world)
    go(simulation, 0.0, 0.0, 5.0)
    assert math.hypot(simulation.pose.x - world.start.x, simulation.pose.y - world.start.y) < 0.002
    assert simulation.pose.heading == pytest.approx(world.start.heading, abs=0.005)
    assert not simulation.touching


def test_the_robot_drives_straight_at_the_commanded_speed(world: World) -> None:
    start = corridor(world)
    simulation = Simulation(world, start)
    go(simulation, 0.4, 0.0, 1.0)
    before = simulation.pose
    go(simulation, 0.4, 0.0, 4.0)
    assert simulation.pose.x - before.x == pytest.approx(1.6, rel=0.03)
    assert abs(simulation.pose.y - start.y) < 0.01
    assert simulation.motion == (pytest.approx(0.4, rel=0.03), pytest.approx(0.0, abs=0.02))
    go(simulation, 0.0, 0.0, 1.0)
    assert abs(simulation.motion[0]) < 0.01


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_the_robot_turns_on_the_spot(world: World, turn: float) -> None:
    start = corridor(world)
    simulation = Simulation(world, start)
    go(simulation, 0.0, turn, 2.0)
    # Wheels that are turned on the spot slip a little.
    assert simulation.pose.heading == pytest.approx(2.0 * turn, rel=0.08)
    assert math.hypot(simulation.pose.x - start.x, simulation.pose.y - start.y) < 0.03


def test_walls_stop_the_robot(world: World) -> None:
    room = max(world.rooms[1:], key=lambda room: room.width * room.depth)
    free = [
        (x, y)
        for x in np.arange(room.left + 0.3, room.right - 0.3, 0.2)
        for y in np.arange(room.bottom + 0.3, room.top - 0.3, 0.2)
        if world.fits(x, y, ROBOT_RADIUS + 0.05)
    ]
    x, y = free[len(free) // 2]
    for heading in (0.0, math.pi / 2, math.pi, -math.pi / 2):
        simulation = Simulation(world, Pose(x, y, heading))
        touched = False
        for _ in range(60):
            go(simulation, 0.5, 0.0, 0.5)
            touched |= simulation.touching
            at = simulation.pose
            # As deep as a contact gives way, no deeper.
            assert world.fits(at.x, at.y, ROBOT_RADIUS - 0.02), f"heading {heading}: it is inside of something at {at}"
        assert touched, f"heading {heading}: after 15 m it met nothing"


def test_the_laser_sees_what_the_map_shows(world: World) -> None:
    grid, cells = world.map.grid, world.map.cells
    occupied = np.argwhere(cells == OCCUPIED)
    middles = np.stack([grid.left + (occupied[:, 1] + 0.5) * 0.05, grid.bottom + (occupied[:, 0] + 0.5) * 0.05], axis=1)
    for place in [world.start, *world.goals(4)]:
        simulation = Simulation(world, place, np.random.default_rng(1))
        ranges = simulation.scan()
        assert len(ranges) == len(simulation.bearings) == 360
        finite = np.isfinite(ranges)
        assert finite.mean() > 0.5
        assert (ranges[finite] >= NEAREST).all()
        assert (ranges[finite] <= FARTHEST).all()
        at = simulation.pose
        x = at.x - 0.04 * math.cos(at.heading) + ranges[finite] * np.cos(at.heading + simulation.bearings[finite])
        y = at.y - 0.04 * math.sin(at.heading) + ranges[finite] * np.sin(at.heading + simulation.bearings[finite])
        away = np.sqrt(((np.stack([x, y], axis=1)[:, None, :] - middles[None]) ** 2).sum(-1)).min(axis=1)
        # From a thing's edge to the middle of its next cell, and noise.
        assert np.quantile(away, 0.95) < 0.075
        assert away.max() < 0.12


def test_odometry_is_accurate_for_metres_and_drifts_later(world: World) -> None:
    """As of a real base: some percent of the way, and a heading that drifts."""
    start = corridor(world)
    errors = []
    for seed in range(5):
        simulation, odometry = Simulation(world, start), Odometry(np.random.default_rng(seed))
        # To and fro and round: 6 m and four half turns.
        for speed, turn, seconds in [(0.4, 0.0, 5.0), (0.0, 1.0, math.pi), (0.4, 0.0, 2.5), (0.0, 1.0, math.pi)] * 2:
            go(simulation, speed, turn, seconds, odometry)
        at, estimate = simulation.pose, odometry.pose
        errors.append(math.hypot(start.x + estimate.x - at.x, start.y + estimate.y - at.y))
        assert errors[-1] < 0.6
    assert max(errors) > 0.02, "a robot whose odometry is never wrong needs no localization"


def test_odometry_reports_the_speed_of_the_wheels(world: World) -> None:
    simulation, odometry = Simulation(world, corridor(world)), Odometry(np.random.default_rng(0))
    go(simulation, 0.3, 0.0, 2.0, odometry)
    assert odometry.pose.x == pytest.approx(simulation.pose.x - corridor(world).x, rel=0.05)
    # Whole ticks of an encoder in 20 ms.
    assert odometry.speed == pytest.approx(0.3, abs=0.03)


def test_the_base_stops_when_commands_end() -> None:
    base = Base(watchdog=0.5)
    assert base.held(0.0)
    assert base.advance(0.0, TICK) == (0.0, 0.0)
    base.command(0.3, 0.2, now=1.0)
    for step in range(25):
        base.advance(1.0 + step * TICK, TICK)
    assert (base.speed, base.turn) == (0.3, 0.2)
    assert not base.held(1.5)
    assert base.held(1.51)
    for step in range(50):
        base.advance(1.52 + step * TICK, TICK)
    assert (base.speed, base.turn) == (0.0, 0.0)


def test_the_base_respects_its_limits_of_speed_and_acceleration() -> None:
    limits = Limits()
    base = Base(limits)
    base.command(9.0, -9.0, now=0.0)
    speeds = [base.advance(0.0, TICK) for _ in range(200)]
    assert speeds[-1] == (limits.speed, -limits.turn)
    assert speeds[0] == (pytest.approx(limits.acceleration * TICK), pytest.approx(-limits.turn_acceleration * TICK))
    base.command(-9.0, 0.0, now=0.0)
    forward = [base.advance(0.0, TICK)[0] for _ in range(200)]
    assert forward[0] == pytest.approx(limits.speed - limits.braking * TICK)
    assert 0.0 in forward
    assert forward[-1] == -limits.speed
