"""A way with how fast it may be gone at each place, and going along it one command at a time.

A motion has no times of its own: it is a place on the way and a speed there. So it can begin, and go on, from wherever
the arm is found on the way, at rest or moving.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from manipulation_arm import Joints
from numpy.typing import NDArray

SPEED, ACCELERATION = 0.4, 1.0
"""rad/s and rad/s² of the joint that moves most."""

_ARRIVED = 1e-4
_CREEP = 0.01


class Command(NamedTuple):
    """Positions in rad and speeds in rad/s for all joints."""

    positions: Joints
    velocities: Joints


class Motion:
    """Going along a way. Its length, and places on it, are rad of the joint that moves most at each place."""

    def __init__(self, way: NDArray[np.float64]) -> None:
        """The positions of ``way`` must be close to each other; two at least."""
        moved = np.abs(np.diff(way, axis=0)).max(axis=1)
        kept = np.concatenate([[True], moved > 1e-9])
        self._way = way[kept] if kept.sum() > 1 else np.repeat(way[-1:], 2, axis=0)
        spans = np.maximum(np.abs(np.diff(self._way, axis=0)).max(axis=1), 1e-9)
        self._places = np.concatenate([[0.0], np.cumsum(spans)])
        self._directions = np.diff(self._way, axis=0) / spans[:, None]
        self._fastest = _fastest(spans, self._directions)
        self._place = 0.0
        self._speed = 0.0

    @property
    def remaining(self) -> float:
        """What is left of the way."""
        return float(self._places[-1]) - self._place

    @property
    def arrived(self) -> bool:
        """Whether it is at the end of the way."""
        return self.remaining <= 0.0

    def off(self, joints: Joints) -> tuple[float, float]:
        """The place on the way that is nearest to a position of the joints, and how far the farthest joint is off it."""
        spans = np.diff(self._places)
        along = np.einsum("ij,ij->i", joints - self._way[:-1], self._directions)
        along = np.clip(along / np.einsum("ij,ij->i", self._directions, self._directions), 0.0, spans)
        nearest = self._way[:-1] + self._directions * along[:, None]
        away = np.abs(joints - nearest).max(axis=1)
        found = int(away.argmin())
        return float(self._places[found] + along[found]), float(away[found])

    def begin(self, place: float, velocities: Joints) -> None:
        """Go on from a place on the way, where the joints have these speeds."""
        self._place = place
        direction = self._directions[self._segment()]
        # Only what goes along the way counts: what goes against it, or aside, ends there.
        self._speed = max(0.0, float(velocities @ direction / (direction @ direction)))

    def rest(self) -> None:
        """Stand still where it is."""
        self._speed = 0.0

    def advance(self, seconds: float) -> Command:
        """The command so many seconds after the one before."""
        allowed = float(np.interp(self._place, self._places, self._fastest))
        self._speed = min(self._speed + ACCELERATION * seconds, max(allowed, _CREEP))
        self._place += self._speed * seconds
        if self.remaining < _ARRIVED:
            self._place, self._speed = float(self._places[-1]), 0.0
        return self.command()

    def command(self) -> Command:
        """Where it is, and how fast."""
        segment = self._segment()
        direction = self._directions[segment]
        positions = self._way[segment] + direction * (self._place - self._places[segment])
        return Command(positions, direction * self._speed)

    def _segment(self) -> int:
        return int(min(np.searchsorted(self._places, self._place, side="right") - 1, len(self._directions) - 1))


def _fastest(spans: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The speed at each corner of a way that leaves time to turn there, and to brake for all that comes after."""
    turns = np.abs(np.diff(directions, axis=0)).max(axis=1, initial=1e-9)
    slower = np.sqrt(ACCELERATION * np.minimum(spans[:-1], spans[1:]) / np.maximum(turns, 1e-9))
    fastest = np.concatenate([[SPEED], np.minimum(SPEED, slower), [0.0]])
    for place in range(len(spans) - 1, -1, -1):
        fastest[place] = min(fastest[place], np.sqrt(fastest[place + 1] ** 2 + 2 * ACCELERATION * spans[place]))
    return fastest
