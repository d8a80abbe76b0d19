"""Pure pursuit along a closed list of waypoints.

Which waypoint is next follows from where the robot is and from nothing that is kept, so an instance that takes over
in the middle of a lap goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from understudy_quickstart.kinematics import Pose, wrapped

Point = tuple[float, float]

WAYPOINTS: tuple[Point, ...] = (
    (1.2, 1.2),
    (4.0, 1.0),
    (6.6, 1.2),
    (7.0, 2.9),
    (6.4, 4.6),
    (4.0, 4.8),
    (1.7, 4.5),
    (1.0, 2.9),
)


class Circuit:
    """A closed line through waypoints; places on it are distances along it from the first one, in m."""

    def __init__(self, waypoints: Sequence[Point]) -> None:
        if len(waypoints) < 2:
            raise ValueError(f"a circuit needs at least 2 waypoints, found {len(waypoints)}")
        self._points = [*waypoints, waypoints[0]]
        self._starts = [0.0]
        for (ax, ay), (bx, by) in zip(self._points, self._points[1:], strict=False):
            self._starts.append(self._starts[-1] + math.hypot(bx - ax, by - ay))
        self.length = self._starts[-1]

    def nearest(self, x: float, y: float) -> float:
        """The place on the line that is nearest to a point."""
        best = (math.inf, 0.0)
        for (ax, ay), (bx, by), start in zip(self._points, self._points[1:], self._starts, strict=False):
            length = math.hypot(bx - ax, by - ay)
            if length == 0:
                continue
            along = ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length
            along = max(0.0, min(length, along))
            distance = math.hypot(ax + (bx - ax) * along / length - x, ay + (by - ay) * along / length - y)
            best = min(best, (distance, start + along))
        return best[1] % self.length

    def at(self, place: float) -> Point:
        """The point at a place; beyond the end the line goes on from its beginning."""
        place %= self.length
        for (ax, ay), (bx, by), start, end in zip(
            self._points, self._points[1:], self._starts, self._starts[1:], strict=False
        ):
            if place <= end and end > start:
                part = (place - start) / (end - start)
                return ax + (bx - ax) * part, ay + (by - ay) * part
        return self._points[0]

    def waypoint_after(self, place: float) -> int:
        """The index of the waypoint that comes next."""
        place %= self.length
        number = next(n for n, end in enumerate(self._starts[1:], 1) if place < end or n == len(self._starts) - 1)
        return number % (len(self._points) - 1)


@dataclass(frozen=True, slots=True)
class Pursuit:
    """How the circuit is followed, in m, rad and s."""

    circuit: Circuit
    speed: float = 0.5
    lookahead: float = 0.6
    stop_at: float = 0.3
    slow_from: float = 0.8

    def command(self, pose: Pose, ahead: float) -> tuple[float, float]:
        """Forward speed and turn rate at a pose, with so much free space ahead."""
        x, y = self.circuit.at(self.circuit.nearest(pose.x, pose.y) + self.lookahead)
        distance = math.hypot(x - pose.x, y - pose.y)
        bearing = wrapped(math.atan2(y - pose.y, x - pose.x) - pose.heading)
        if abs(bearing) > 1.0:  # rather turn on the spot than drive a wide arc
            return 0.0, math.copysign(1.2, bearing)
        caution = (ahead - self.stop_at) / (self.slow_from - self.stop_at)
        speed = self.speed * max(0.0, min(1.0, caution)) * math.cos(bearing)
        return speed, speed * 2 * math.sin(bearing) / max(distance, 1e-3)


def space_ahead(ranges: Sequence[float], first_bearing: float, step: float, *, cone: float = 0.35) -> float:
    """The nearest range within a cone ahead, as a LaserScan gives them; ``inf`` where nothing is seen."""
    seen = (
        distance
        for number, distance in enumerate(ranges)
        if abs(wrapped(first_bearing + number * step)) <= cone and math.isfinite(distance)
    )
    return min(seen, default=math.inf)
