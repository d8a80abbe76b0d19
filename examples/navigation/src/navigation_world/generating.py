"""Worlds from seeds: a floor plan, things that stand about, and places that the robot can get to.

Nothing is placed by hand: a seed decides all of it, and what makes a world unusable is drawn again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from navigation_world.geometry import Array, Box, Pillar, Pose, Rectangle, Shape, clearance
from navigation_world.grids import FREE, OCCUPIED, UNKNOWN, Grid, Map, component
from navigation_world.partition import Door, plan

WIDTH, DEPTH = 11.0, 8.0
"""The floor's size inside of its outer walls."""

HEIGHT = 0.5
"""How high walls and things are; the laser looks well below."""

ROBOT_RADIUS = 0.18
PASSAGE = ROBOT_RADIUS + 0.12
"""Half of the narrowest way that counts as one: the robot, and space for a map's cells and for a controller's errors."""

ROOM_TO_TURN = ROBOT_RADIUS + 0.2
"""How far from everything goals and the start are."""

CLUTTER = 0.25
"""Things per square metre that are tried."""

DOORWAY = 0.9
"""Nothing stands closer than this to the middle of a door."""

RESOLUTION = 0.05
"""The side of a map's cell."""

MARGIN = 0.5
"""How far the map reaches beyond the walls: a map seldom begins at 0, 0."""

LEAST_WAY = 2.5
"""How far a goal is from the one before it, at least, as the crow flies."""

_ATTEMPTS = 100


@dataclass(frozen=True)
class World:
    """A floor with rooms and things. Its frame is the map's: x to the right, y up, 0, 0 in a corner of the floor."""

    seed: int
    rooms: tuple[Rectangle, ...]
    doors: tuple[Door, ...]
    walls: tuple[Box, ...]
    things: tuple[Shape, ...]
    start: Pose = field(default=Pose(0.0, 0.0, 0.0))
    """Where the robot stands at first."""

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Everything that a robot can run into."""
        return (*self.walls, *self.things)

    def clearance(self, x: Array, y: Array) -> Array:
        """How far the nearest thing is from each point; zero or less inside of one or outside of the floor."""
        inside = np.minimum(np.minimum(x, WIDTH - x), np.minimum(y, DEPTH - y))
        return np.minimum(inside, clearance(self.shapes, x, y))

    def fits(self, x: float, y: float, radius: float = ROBOT_RADIUS) -> bool:
        """Whether something round of that radius touches nothing there."""
        return bool(self.clearance(np.array([x]), np.array([y]))[0] >= radius)

    @cached_property
    def map(self) -> Map:
        """The map that a robot is given. What a laser cannot see, it does not know: beyond the outer walls."""
        grid = Grid(
            -MARGIN,
            -MARGIN,
            round((WIDTH + 2 * MARGIN) / RESOLUTION),
            round((DEPTH + 2 * MARGIN) / RESOLUTION),
            RESOLUTION,
        )
        x, y = grid.centres()
        occupied = clearance(self.shapes, x, y) <= 0
        outside = (x < 0) | (x > WIDTH) | (y < 0) | (y > DEPTH)
        return Map(grid, np.where(occupied, OCCUPIED, np.where(outside, UNKNOWN, FREE)).astype(np.int8))

    @cached_property
    def _reach(self) -> tuple[Grid, Array, NDArray[np.bool_]]:
        """A raster of the floor, the clearance there, and whether the robot gets there from its start."""
        grid = _raster()
        free = self.clearance(*grid.centres())
        return grid, free, component(free >= PASSAGE, grid.cell(self.start.x, self.start.y))

    def reachable(self, x: float, y: float) -> bool:
        """Whether the robot gets there from its start, through ways that are wide enough."""
        grid, _, reached = self._reach
        row, column = grid.cell(x, y)
        return 0 <= row < grid.rows and 0 <= column < grid.columns and bool(reached[row, column])

    def goals(self, count: int, seed: int | None = None) -> list[Pose]:
        """Random places for the robot to drive to, one after the other; the same for the same seed.

        Args:
            count: how many.
            seed: another than the world's own, for another tour.
        """
        grid, free, reached = self._reach
        random = np.random.default_rng([self.seed, 1 if seed is None else 2 + seed])
        places = np.argwhere(reached & (free >= ROOM_TO_TURN + grid.resolution))
        x, y = grid.centres()
        found: list[Pose] = []
        at = self.start
        for _ in range(count):
            far = [(r, c) for r, c in places if math.hypot(x[r, c] - at.x, y[r, c] - at.y) >= LEAST_WAY]
            row, column = far[int(random.integers(len(far)))]
            at = Pose(float(x[row, column]), float(y[row, column]), float(random.uniform(-math.pi, math.pi)))
            found.append(at)
        return found


def generate(seed: int) -> World:
    """The world of a seed."""
    random = np.random.default_rng(seed)
    for _ in range(_ATTEMPTS):
        try:
            floor = plan(WIDTH, DEPTH, HEIGHT, random)
        except ValueError:
            continue
        world = _furnished(World(seed, floor.rooms, floor.doors, floor.walls, ()), random)
        start = _start(world, random)
        if start is not None:
            return World(seed, world.rooms, world.doors, world.walls, world.things, start)
    raise RuntimeError(f"seed {seed}: no usable floor plan in {_ATTEMPTS} attempts")


def _raster() -> Grid:
    return Grid(0.0, 0.0, round(WIDTH / RESOLUTION), round(DEPTH / RESOLUTION), RESOLUTION)


def _furnished(world: World, random: np.random.Generator) -> World:
    """Puts boxes and pillars about, turned as it comes, but never so that a way or a place is closed off."""
    grid = _raster()
    x, y = grid.centres()
    free = world.clearance(x, y)
    things: list[Shape] = []
    for room in world.rooms:
        for _ in range(round(room.width * room.depth * CLUTTER)):
            thing = _thing(room, random)
            if any(float(thing.distance(np.array(door.x), np.array(door.y))) < DOORWAY for door in world.doors):
                continue
            with_it = np.minimum(free, thing.distance(x, y))
            ways = with_it >= PASSAGE
            if ways.any() and component(ways, _first(ways)).sum() == ways.sum():
                things.append(thing)
                free = with_it
    return World(world.seed, world.rooms, world.doors, world.walls, tuple(things))


def _thing(room: Rectangle, random: np.random.Generator) -> Shape:
    x = float(random.uniform(room.left, room.right))
    y = float(random.uniform(room.bottom, room.top))
    if random.random() < 0.3:
        return Pillar(x, y, float(random.uniform(0.08, 0.2)), HEIGHT)
    width, depth = random.uniform(0.1, 0.35, 2)
    return Box(x, y, float(width), float(depth), float(random.uniform(0.0, math.pi)), HEIGHT)


def _first(free: NDArray[np.bool_]) -> tuple[int, int]:
    row, column = np.unravel_index(int(free.argmax()), free.shape)
    return int(row), int(column)


def _start(world: World, random: np.random.Generator) -> Pose | None:
    grid = _raster()
    x, y = grid.centres()
    free = world.clearance(x, y)
    ways = free >= PASSAGE
    if not ways.any() or component(ways, _first(ways)).sum() < ways.sum():
        return None
    row, column = random.choice(np.argwhere(free >= ROOM_TO_TURN + grid.resolution))
    return Pose(float(x[row, column]), float(y[row, column]), float(random.uniform(-math.pi, math.pi)))
