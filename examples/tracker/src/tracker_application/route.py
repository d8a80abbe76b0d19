"""The way that the robot is driven, over and over: straight on, with turns, a rest, and out of the camera's sight."""

from __future__ import annotations

import math
from itertools import pairwise

WAYPOINTS = ((0.6, -0.3), (0.0, 1.5), (-0.6, -0.3))
"""x and y in m. The second is out of the camera's sight; at the last there is a rest."""

REST = 2.0
"""Seconds."""

SPEED, TURN = 0.3, 1.0
"""m/s and rad/s, at most."""

REACHED = 0.08
"""m from a waypoint that are near enough."""

STRAIGHT = 0.15
"""rad from the way to a waypoint beyond which it turns on the spot."""


class Route:
    """Where to next. An instance that begins anywhere on the way goes on from there."""

    def __init__(self) -> None:
        self._next: int | None = None
        self._rests = -math.inf

    def command(self, x: float, y: float, heading: float, now: float) -> tuple[float, float]:
        """The speed in m/s and the turn rate in rad/s, by where the robot is; ``now`` in seconds of any steady clock."""
        if self._next is None:
            self._next = nearest(x, y)
        if now < self._rests:
            return 0.0, 0.0
        dx, dy = (there - here for there, here in zip(WAYPOINTS[self._next], (x, y), strict=True))
        distance = math.hypot(dx, dy)
        if distance < REACHED:
            self._rests = now + REST if self._next == len(WAYPOINTS) - 1 else now
            self._next = (self._next + 1) % len(WAYPOINTS)
            return 0.0, 0.0
        off = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        turn = min(TURN, max(-TURN, 1.5 * off))
        if abs(off) > STRAIGHT:
            return 0.0, turn
        return min(SPEED, 0.8 * distance + 0.1), turn


def nearest(x: float, y: float) -> int:
    """The waypoint at the end of the leg that a place is nearest to."""
    legs = list(pairwise((WAYPOINTS[-1], *WAYPOINTS)))

    def distance(leg: tuple[tuple[float, float], tuple[float, float]]) -> float:
        (ax, ay), (bx, by) = leg
        dx, dy = bx - ax, by - ay
        part = max(0.0, min(1.0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)))
        return math.hypot(ax + part * dx - x, ay + part * dy - y)

    return min(range(len(legs)), key=lambda index: distance(legs[index]))
