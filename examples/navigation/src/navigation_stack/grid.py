"""Occupancy grids: what is free, and how far it is to what is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OCCUPIED = 65
"""Occupancy in percent from which a cell is an obstacle (Nav2's default occupied_thresh)."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A map of cells; row 0 is the lowest y, column 0 the lowest x (as in nav_msgs/OccupancyGrid)."""

    cells: NDArray[np.int8]
    """Occupancy in percent, -1 where it is not known; rows by columns."""
    resolution: float
    """Side of a cell in m."""
    x: float = 0.0
    """Place of the lower left corner of cell (0, 0) in the map frame, in m."""
    y: float = 0.0

    def __post_init__(self) -> None:
        if self.cells.ndim != 2 or not self.cells.size:
            raise ValueError(f"a grid has rows and columns, found an array of shape {self.cells.shape}")
        if not self.resolution > 0:
            raise ValueError(f"resolution: found {self.resolution} m, which must be more than 0")

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """Row and column of a place; None outside the grid."""
        row, column = int((y - self.y) // self.resolution), int((x - self.x) // self.resolution)
        rows, columns = self.cells.shape
        return (row, column) if 0 <= row < rows and 0 <= column < columns else None

    def place(self, row: float, column: float) -> tuple[float, float]:
        """The centre of a cell."""
        return self.x + (column + 0.5) * self.resolution, self.y + (row + 0.5) * self.resolution

    @property
    def obstacles(self) -> NDArray[np.bool_]:
        """Cells that are known to be occupied."""
        return self.cells >= OCCUPIED

    @property
    def blocked(self) -> NDArray[np.bool_]:
        """Cells that must not be driven on: occupied or unknown."""
        return (self.cells >= OCCUPIED) | (self.cells < 0)


def distances(marked: NDArray[np.bool_], resolution: float, most: float) -> NDArray[np.float32]:
    """Distance of each cell's centre to the centre of the nearest marked one, in m, exact up to ``most``.

    The square of the distance is the least over columns of (distance in the column)^2 + (distance of the columns)^2, so
    two passes over one dimension each are enough.
    """
    reach = int(np.ceil(most / resolution))
    rows, columns = marked.shape
    along = np.full(marked.shape, float(reach), dtype=np.float32)
    run = np.full(columns, float(reach), dtype=np.float32)
    for order in (range(rows), range(rows - 1, -1, -1)):
        run[:] = reach
        for row in order:
            run += 1
            run[marked[row]] = 0
            np.minimum(along[row], run, out=along[row])
    squares = along**2
    best = squares.copy()
    for shift in range(1, min(reach, columns - 1) + 1):
        np.minimum(best[:, shift:], squares[:, :-shift] + shift * shift, out=best[:, shift:])
        np.minimum(best[:, :-shift], squares[:, shift:] + shift * shift, out=best[:, :-shift])
    return np.minimum(np.sqrt(best) * resolution, most).astype(np.float32)
