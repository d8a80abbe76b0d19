"""A robot in a generated world without ROS: it follows its commands, its odometry drifts, and its laser is noisy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from navigation_stack.filter import ParticleFilter
from navigation_stack.grid import Grid
from navigation_stack.planning import Planner
from navigation_stack.poses import Pose
from navigation_stack.pursuit import Command, Pursuit
from navigation_world import World, generate
from numpy.typing import NDArray

PERIOD = 0.05
ORIGIN = Pose(0.0, 0.0, 0.0)
BEARINGS = np.linspace(-math.pi, math.pi, 90, endpoint=False).astype(np.float32)
SPREAD = [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]]


def charted(world: World) -> Grid:
    raster = world.map.grid
    return Grid(world.map.cells, raster.resolution, raster.left, raster.bottom)


def as_pose(place: object) -> Pose:
    return Pose(place.x, place.y, place.heading)  # type: ignore[attr-defined]


def cast(world: World, pose: Pose, reach: float = 8.0) -> NDArray[np.float32]:
    """Ranges at BEARINGS: along each ray by as much as is free around its tip, until nothing is."""
    directions = BEARINGS + pose.heading
    ranges = np.zeros(len(BEARINGS))
    for _ in range(60):
        step = world.clearance(pose.x + ranges * np.cos(directions), pose.y + ranges * np.sin(directions))
        if step.max() < 2e-3:
            break
        ranges = np.minimum(ranges + np.maximum(step, 0.0), reach)
    return np.where(ranges < reach, ranges, np.inf).astype(np.float32)


@dataclass
class Robot:
    world: World
    pose: Pose
    odometry: Pose = ORIGIN
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def drive(self, command: Command) -> None:
        step = arc(command.linear * PERIOD, command.angular * PERIOD)
        self.pose = self.pose.then(step)
        # Wheels of slightly different size, and slip.
        length, turn = (1 + self.random.normal(0.01, 0.03, 2)) * (command.linear * PERIOD, command.angular * PERIOD)
        self.odometry = self.odometry.then(arc(length, turn + 0.01 * length))

    def scan(self) -> NDArray[np.float32]:
        ranges = cast(self.world, self.pose)
        return (ranges + self.random.normal(0, 0.01, len(ranges))).astype(np.float32)

    @property
    def clearance(self) -> float:
        return float(self.world.clearance(np.array([self.pose.x]), np.array([self.pose.y]))[0])


def arc(length: float, turn: float) -> Pose:
    chord = length * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
    return Pose(chord * math.cos(turn / 2), chord * math.sin(turn / 2), turn)


@dataclass
class Tour:
    """The result of a tour: localization errors in m and rad, clearances, and the final pose for each goal."""

    errors: list[float] = field(default_factory=list)
    turned: list[float] = field(default_factory=list)
    clearances: list[float] = field(default_factory=list)
    ends: list[tuple[Pose, Pose]] = field(default_factory=list)
    seconds: float = 0.0


def tour(seed: int, goals: int, *, start_error: Pose = ORIGIN) -> Tour:
    """Drive to goals as the stack does: scans at 10 Hz, commands at 20 Hz, a plan each second."""
    world = generate(seed)
    grid = charted(world)
    robot = Robot(world, as_pose(world.start))
    particles = ParticleFilter(grid, seed=1)
    particles.spread(robot.pose.then(start_error), SPREAD)
    planner, pursuit, done = Planner(grid), Pursuit(), Tour()
    last, scan, estimate = robot.odometry, robot.scan(), particles.estimate()[0]
    for goal in map(as_pose, world.goals(goals)):
        for tick in range(int(120 / PERIOD)):
            if tick % 20 == 0:
                pursuit.follow(planner.plan(estimate, goal))
            if tick % 2 == 0:
                scan = robot.scan()
                particles.move(last.to(robot.odometry))
                last = robot.odometry
                particles.sense(scan, BEARINGS, ORIGIN)
                estimate = particles.estimate()[0]
                done.errors.append(estimate.distance(robot.pose))
                done.turned.append(abs(math.remainder(estimate.heading - robot.pose.heading, math.tau)))
            now = estimate.then(last.to(robot.odometry))
            finite = np.isfinite(scan)
            obstacles = np.column_stack(
                [scan[finite] * np.cos(BEARINGS[finite]), scan[finite] * np.sin(BEARINGS[finite])]
            )
            command = pursuit.command(now, obstacles, PERIOD)
            robot.drive(command)
            done.clearances.append(robot.clearance)
            done.seconds += PERIOD
            if command.reached:
                break
        done.ends.append((robot.pose, goal))
    return done
