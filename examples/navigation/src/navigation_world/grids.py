"""Squares of the plane: which of them belong together, and the map that a robot is given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from navigation_world.geometry import Array

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cells of a map, as nav_msgs/OccupancyGrid has them."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the squares of a raster are; row 0 is at the bottom."""

    left: float
    bottom: float
    columns: int
    rows: int
    resolution: float

    def centres(self) -> tuple[Array, Array]:
        """x and y of the middle of each cell."""
        x = self.left + (np.arange(self.columns) + 0.5) * self.resolution
        y = self.bottom + (np.arange(self.rows) + 0.5) * self.resolution
        columns, rows = np.meshgrid(x, y)
        return columns, rows

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of the cell that a point is in; it may be outside of the raster."""
        return int((y - self.bottom) // self.resolution), int((x - self.left) // self.resolution)


@dataclass(frozen=True, slots=True)
class Map:
    """An occupancy map; its frame is the world's."""

    grid: Grid
    cells: NDArray[np.int8]
    """FREE, OCCUPIED or UNKNOWN, rows from the bottom."""


def component(free: NDArray[np.bool_], seed: tuple[int, int]) -> NDArray[np.bool_]:
    """The free cells that can be reached from a cell, from edge to edge."""
    found = np.zeros_like(free)
    if not free[seed]:
        return found
    found[seed] = True
    while True:
        grown = found.copy()
        # Whole lines at once: in a room a step fills as far as one can see along it.
        for axis in (0, 1):
            for flip in (slice(None), slice(None, None, -1)):
                turn = (flip, slice(None)) if axis == 0 else (slice(None), flip)
                grown[turn] = _spread(grown[turn], free[turn], axis)
        if (grown == found).all():
            return found
        found = grown


def _spread(found: NDArray[np.bool_], free: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Carries what is found along an axis until something is in the way."""
    number = np.arange(found.shape[axis], dtype=np.int16).reshape((-1, 1) if axis == 0 else (1, -1))
    last_found = np.maximum.accumulate(np.where(found & free, number, np.int16(-1)), axis=axis)
    last_blocked = np.maximum.accumulate(np.where(free, np.int16(-1), number), axis=axis)
    return free & (last_found > last_blocked)
