"""The room: four walls, a shelf, a crate and a pillar; what a laser sees of it and what a map shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from understudy_quickstart.kinematics import Pose

Array = NDArray[np.float64]

ROBOT_RADIUS = 0.2
START = Pose(1.2, 1.2, 0.0)


@dataclass(frozen=True, slots=True)
class Box:
    """An axis-aligned box, in m."""

    left: float
    bottom: float
    right: float
    top: float

    def segments(self) -> list[tuple[float, float, float, float]]:
        """Its four sides as x, y, x, y."""
        return [
            (self.left, self.bottom, self.right, self.bottom),
            (self.right, self.bottom, self.right, self.top),
            (self.right, self.top, self.left, self.top),
            (self.left, self.top, self.left, self.bottom),
        ]


@dataclass(frozen=True, slots=True)
class Pillar:
    """A round pillar, in m."""

    x: float
    y: float
    radius: float


class Room:
    """A rectangular room with things in it."""

    def __init__(self, width: float, depth: float, boxes: list[Box], pillars: list[Pillar]) -> None:
        self.width = width
        self.depth = depth
        self._boxes = np.array([(b.left, b.bottom, b.right, b.top) for b in boxes]).reshape(-1, 4)
        self._pillars = np.array([(p.x, p.y, p.radius) for p in pillars]).reshape(-1, 3)
        sides = [Box(0.0, 0.0, width, depth), *boxes]
        self._segments = np.array([segment for side in sides for segment in side.segments()])

    def ray_cast(self, pose: Pose, bearings: Array, reach: float) -> Array:
        """The distance to the first thing along each bearing (rad, from the heading); ``inf`` beyond the reach."""
        angles = pose.heading + bearings
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        nearest = np.minimum(self._to_segments(pose, direction), self._to_pillars(pose, direction))
        return np.where(nearest <= reach, nearest, np.inf)

    def _to_segments(self, pose: Pose, direction: Array) -> Array:
        start = self._segments[:, :2] - (pose.x, pose.y)
        along = self._segments[:, 2:] - self._segments[:, :2]
        # The ray t * d meets the segment start + u * along where both cross products below say so.
        cross = direction[:, None, 0] * along[None, :, 1] - direction[:, None, 1] * along[None, :, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0])[None, :] / cross
            place = (start[None, :, 0] * direction[:, None, 1] - start[None, :, 1] * direction[:, None, 0]) / cross
        hit = (cross != 0) & (distance >= 0) & (place >= 0) & (place <= 1)
        return np.where(hit, distance, np.inf).min(axis=1)

    def _to_pillars(self, pose: Pose, direction: Array) -> Array:
        if not len(self._pillars):
            return np.full(len(direction), np.inf)
        centre = self._pillars[:, :2] - (pose.x, pose.y)
        middle = direction @ centre.T
        aside = (centre**2).sum(axis=1)[None, :] - middle**2
        half = np.sqrt(np.maximum(self._pillars[:, 2] ** 2 - aside, 0.0))
        distance = middle - half
        hit = (aside <= self._pillars[:, 2] ** 2) & (distance >= 0)
        return np.where(hit, distance, np.inf).min(axis=1)

    def clearance(self, x: Array, y: Array) -> Array:
        """How far the nearest thing is from each point; zero or less inside of one or outside of the room."""
        free = np.minimum(np.minimum(x, self.width - x), np.minimum(y, self.depth - y))
        for left, bottom, right, top in self._boxes:
            dx = np.maximum(left - x, x - right)
            dy = np.maximum(bottom - y, y - top)
            outside = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0))
            free = np.minimum(free, outside + np.minimum(np.maximum(dx, dy), 0.0))
        for px, py, radius in self._pillars:
            free = np.minimum(free, np.hypot(x - px, y - py) - radius)
        return free

    def fits(self, pose: Pose, radius: float) -> bool:
        """Whether a round robot of that radius touches nothing there."""
        return bool(self.clearance(np.array([pose.x]), np.array([pose.y]))[0] >= radius)

    def occupancy(self, resolution: float) -> NDArray[np.int8]:
        """The room as nav_msgs/OccupancyGrid has it: rows from the bottom, 100 where something is and 0 where not."""
        columns = np.arange(round(self.width / resolution)) * resolution + resolution / 2
        rows = np.arange(round(self.depth / resolution)) * resolution + resolution / 2
        x, y = np.meshgrid(columns, rows)
        # A wall has no thickness of its own, so a cell counts as occupied where it touches one.
        return np.where(self.clearance(x, y) <= resolution / 2 + 1e-9, 100, 0).astype(np.int8)


def quickstart_room() -> Room:
    """The room of the quickstart: 8 m x 6 m."""
    return Room(
        width=8.0,
        depth=6.0,
        boxes=[Box(2.3, 2.5, 5.7, 3.4), Box(0.0, 5.2, 0.9, 6.0)],
        pillars=[Pillar(7.4, 5.4, 0.25)],
    )
