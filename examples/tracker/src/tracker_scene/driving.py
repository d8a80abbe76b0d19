"""Ordinary driving: to places in and out of the picture, with turns, stops and a little slip, commanded at 20 Hz.

What is between a command and the robot's motion is as in reality: it comes a little later, and its base
limits the acceleration.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from tracker_scene.scene import Scene

PERIOD = 0.05
"""Seconds between commands."""

LATE = 0.08
"""Seconds until a command has come to the robot's base."""

ACCELERATION, TURN_ACCELERATION = 0.8, 2.0
"""What the base limits to, in m/s2 and rad/s2."""

SPEEDS = (0.12, 0.2, 0.3, 0.4)
MOST_SLIP = 0.12
WITHIN, BEYOND = (1.5, 1.0), (3.2, 2.6)
"""Half of the place that is driven in: what the camera sees of the floor, and more."""


@dataclass
class Base:
    """The robot's base: commands come late, and speeds change evenly."""

    scene: Scene
    _coming: deque[tuple[float, float, float]] = field(default_factory=deque)
    _wanted: tuple[float, float] = (0.0, 0.0)
    _speeds: tuple[float, float] = (0.0, 0.0)

    def command(self, speed: float, turn: float) -> None:
        """A command is sent now."""
        self._coming.append((self.scene.time + LATE, speed, turn))

    def step(self, seconds: float) -> None:
        """Go on by a time that is short."""
        while self._coming and self._coming[0][0] <= self.scene.time + 1e-9:
            _, *wanted = self._coming.popleft()
            self._wanted = wanted[0], wanted[1]
        speed, turn = self._speeds
        most, most_turn = ACCELERATION * seconds, TURN_ACCELERATION * seconds
        speed += min(most, max(-most, self._wanted[0] - speed))
        turn += min(most_turn, max(-most_turn, self._wanted[1] - turn))
        self._speeds = speed, turn
        self.scene.drive(speed, turn)
        self.scene.step(seconds)


class Driver:
    """Commands a robot about, by where it really is."""

    def __init__(self, scene: Scene, seed: int, *, leaves: bool = True) -> None:
        """With ``leaves`` some of the places that it drives to are out of the picture."""
        self._scene, self._random, self._leaves = scene, np.random.default_rng(seed), leaves
        self._rest = 0.0
        self._choose()

    def _choose(self) -> None:
        random = self._random
        half = BEYOND if self._leaves and random.random() < 0.4 else WITHIN
        self._target = random.uniform(-half[0], half[0]), random.uniform(-half[1], half[1])
        self._speed = float(random.choice(SPEEDS))
        self._arcs = bool(random.random() < 0.5)
        self._scene.slip = float(random.uniform(0, MOST_SLIP))
        if random.random() < 0.4:
            self._rest = self._scene.time + float(random.uniform(0.3, 4.0))

    def command(self) -> tuple[float, float]:
        """What to command now: m/s and rad/s."""
        scene = self._scene
        if scene.time < self._rest:
            return 0.0, 0.0
        x, y, heading = scene.pose
        dx, dy = self._target[0] - x, self._target[1] - y
        distance = math.hypot(dx, dy)
        if distance < 0.1:
            self._choose()
            return 0.0, 0.0
        off = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        turn = min(1.0, max(-1.0, 1.5 * off))
        if abs(off) > (1.0 if self._arcs else 0.15):
            return 0.0, turn
        return min(self._speed, 0.5 * distance + 0.05), turn
