"""Global paths: the cheapest way through an inflated grid, drawn taut.

The cost to go is spread from the goal (Dijkstra), as Nav2's NavFn does, and kept: while the goal stays, a new plan from
wherever the robot has got to needs no search. It is spread only as far as it was asked for.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from navigation_stack.grid import Grid, distances
from navigation_stack.poses import Pose, wrapped


class NoPath(Exception):
    """There is no way; the text says why."""


class StartBlocked(NoPath):
    """The robot stands where it cannot stand."""


class GoalBlocked(NoPath):
    """The goal is where the robot cannot stand, and so is everything within the tolerance."""


@dataclass(frozen=True, slots=True)
class Inflation:
    """What driving near obstacles costs; names as in Nav2's inflation layer, in m."""

    robot_radius: float = 0.18
    margin: float = 0.08
    """On top of the radius, never entered: cells are squares, and obstacles reach beyond the centres of theirs."""
    inflation_radius: float = 0.7
    cost_scaling_factor: float = 6.0
    weight: float = 6.0
    """How many times longer a way may be to stay clear of an obstacle that it would touch otherwise."""


class Terrain:
    """What it costs to be in each cell of a grid."""

    def __init__(self, grid: Grid, inflation: Inflation | None = None) -> None:
        self.grid = grid
        want = inflation or Inflation()
        self._columns = grid.cells.shape[1] + 2
        keep_away = want.robot_radius + want.margin
        # Framed by a cell that cannot be entered, so that no neighbour is ever outside of the array.
        clearance = np.pad(distances(grid.blocked, grid.resolution, max(want.inflation_radius, keep_away)), 1)
        near = np.exp(-want.cost_scaling_factor * (clearance - keep_away))
        near[clearance >= want.inflation_radius] = 0.0
        costs = 1.0 + want.weight * near
        costs[clearance < keep_away] = np.inf
        self._costs: NDArray[np.float64] = costs.astype(np.float64).ravel()
        self.costs: list[float] = self._costs.tolist()
        """By index; infinite where the robot cannot be. A list, since reading single numbers of an array is slow."""
        diagonal = math.sqrt(2)
        c = self._columns
        self.neighbours = [(1, 1.0), (-1, 1.0), (c, 1.0), (-c, 1.0)] + [
            (n, diagonal) for n in (c + 1, c - 1, -c + 1, -c - 1)
        ]

    def place(self, index: int) -> tuple[float, float]:
        """The centre of the cell with an index."""
        row, column = divmod(index, self._columns)
        return self.grid.place(row - 1, column - 1)

    def nearest(self, x: float, y: float, within: float) -> int | None:
        """Index of the nearest cell that can be entered, no farther than so many m."""
        grid = self.grid
        column = math.floor((x - grid.x) / grid.resolution) + 1
        row = math.floor((y - grid.y) / grid.resolution) + 1
        rows = len(self.costs) // self._columns
        reach = math.ceil(within / grid.resolution)
        best: tuple[float, int] | None = None
        for r in range(max(0, row - reach), min(rows, row + reach + 1)):
            for c in range(max(0, column - reach), min(self._columns, column + reach + 1)):
                index = r * self._columns + c
                if self.costs[index] < math.inf:
                    px, py = self.place(index)
                    off = math.hypot(px - x, py - y)
                    if off <= within + grid.resolution and (best is None or off < best[0]):
                        best = (off, index)
        return best[1] if best else None

    def along(self, ax: float, ay: float, bx: float, by: float) -> float:
        """Cost of the straight line between two places, in cells; infinite where it cannot be driven."""
        resolution = self.grid.resolution
        length = math.hypot(bx - ax, by - ay) / resolution
        count = max(2, math.ceil(2 * length) + 1)
        part = np.linspace(0.0, 1.0, count)
        columns = np.floor((ax + (bx - ax) * part - self.grid.x) / resolution).astype(np.intp) + 1
        rows = np.floor((ay + (by - ay) * part - self.grid.y) / resolution).astype(np.intp) + 1
        return float(self._costs[rows * self._columns + columns].mean()) * length


class CostToGo:
    """The cost from everywhere to one goal, spread as far as it is asked for."""

    def __init__(self, terrain: Terrain, goal: int) -> None:
        self._terrain = terrain
        count = len(terrain.costs)
        self._best = [math.inf] * count
        self._next = [-1] * count
        self._done = bytearray(count)
        self._best[goal] = 0.0
        self._open = [(0.0, goal)]

    def way(self, start: int) -> list[int]:
        """Indices of the cells from a start to the goal. Raises NoPath."""
        self._spread(start)
        if not self._done[start]:
            raise NoPath("obstacles lie all around the goal or the robot")
        way = [start]
        while (following := self._next[way[-1]]) >= 0:
            way.append(following)
        return way

    def _spread(self, until: int) -> None:
        costs, best, following, done, border = (
            self._terrain.costs,
            self._best,
            self._next,
            self._done,
            self._open,
        )
        while border and not done[until]:
            cost, index = heapq.heappop(border)
            if done[index]:
                continue
            done[index] = 1
            here = costs[index]
            for offset, length in self._terrain.neighbours:
                other = index + offset
                there = costs[other]
                if there == math.inf or done[other]:
                    continue
                total = cost + length * 0.5 * (here + there)
                if total < best[other]:
                    best[other] = total
                    following[other] = index
                    heapq.heappush(border, (total, other))


class Planner:
    """Plans on one map."""

    def __init__(self, grid: Grid, inflation: Inflation | None = None, *, tolerance: float = 0.25) -> None:
        self._terrain = Terrain(grid, inflation)
        self._tolerance = tolerance
        self._to: tuple[int, CostToGo] | None = None

    def plan(self, start: Pose, goal: Pose) -> list[Pose]:
        """A path from a pose to a goal, about one pose for each cell. Raises NoPath.

        A goal where the robot cannot stand is moved by as much as the tolerance; a start by as much as the robot may be
        off by mistakes of localization.
        """
        terrain = self._terrain
        first = terrain.nearest(start.x, start.y, 0.3)
        if first is None:
            raise StartBlocked(
                f"the robot is at {start.x:.2f}, {start.y:.2f}, where the map has an obstacle or nothing"
            )
        last = terrain.nearest(goal.x, goal.y, self._tolerance)
        if last is None:
            raise GoalBlocked(
                f"the goal {goal.x:.2f}, {goal.y:.2f} and all within {self._tolerance} m of it are too near to an "
                "obstacle or not in the map"
            )
        if self._to is None or self._to[0] != last:
            self._to = (last, CostToGo(terrain, last))
        corners = self._taut([terrain.place(index) for index in self._to[1].way(first)])
        corners[0] = (start.x, start.y)
        if terrain.along(*corners[-1], goal.x, goal.y) < math.inf:
            corners[-1] = (goal.x, goal.y)
        return resampled(corners, terrain.grid.resolution, goal.heading)

    def _taut(self, places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        """Leaves out the places between two where the straight line costs hardly more."""
        along = self._terrain.along
        totals = [0.0]
        for a, b in itertools.pairwise(places):
            totals.append(totals[-1] + along(*a, *b))
        corners = [places[0]]
        at = 0
        while at < len(places) - 1:
            low, step = at + 1, 2
            # Gallops ahead while the line is good enough, then halves back to where it ceased to be.
            while (to := min(at + step, len(places) - 1)) > low:
                if along(*places[at], *places[to]) > 1.02 * (totals[to] - totals[at]) + 1e-6:
                    break
                low, step = to, 2 * step
            high = to
            while high - low > 1:
                middle = (low + high) // 2
                if along(*places[at], *places[middle]) <= 1.02 * (totals[middle] - totals[at]) + 1e-6:
                    low = middle
                else:
                    high = middle
            at = low
            corners.append(places[at])
        if len(corners) == 1:
            corners.append(places[-1])
        return corners


def resampled(corners: Sequence[tuple[float, float]], spacing: float, heading: float) -> list[Pose]:
    """Poses along a line of corners, each looking along it, the last one with a heading of its own."""
    poses: list[Pose] = []
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        length = math.hypot(bx - ax, by - ay)
        if length < 1e-6:
            continue
        steps = max(1, round(length / spacing))
        direction = math.atan2(by - ay, bx - ax)
        poses += [Pose(ax + (bx - ax) * n / steps, ay + (by - ay) * n / steps, direction) for n in range(steps)]
    return [*poses, Pose(*corners[-1], wrapped(heading))]
