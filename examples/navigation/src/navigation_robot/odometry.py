"""Wheel odometry: where the robot would be if its wheels told the truth.

They do not: encoders count whole ticks, tyres are a little larger or smaller than believed and stand a little further
apart, and wheels slip, which the physics brings by itself. The first two are Borenstein and Feng's systematic errors
("Measurement and correction of systematic odometry errors in mobile robots", IEEE Trans. Robotics and Automation 12(6),
1996), drawn once for a robot.
"""

from __future__ import annotations

import math

import numpy as np
from navigation_world import Pose

from navigation_robot.model import TRACK, WHEEL_RADIUS

TICKS = 508.8
"""Encoder ticks in one turn of a wheel, those of the Create 3."""

WHEEL_ERROR = 0.005
TRACK_ERROR = 0.01
"""Standard deviations of what is wrongly believed, as parts of the whole."""


class Odometry:
    """Adds up what the wheels' encoders say. Its frame begins where the robot stands at first."""

    def __init__(self, random: np.random.Generator) -> None:
        """``random`` draws what this robot believes wrongly."""
        self._radii = WHEEL_RADIUS * (1 + random.normal(0.0, WHEEL_ERROR, 2))
        self._track = TRACK * (1 + random.normal(0.0, TRACK_ERROR))
        self._ticks: tuple[int, int] | None = None
        self.pose = Pose(0.0, 0.0, 0.0)
        self.speed = 0.0
        self.turn = 0.0

    def update(self, left: float, right: float, seconds: float) -> None:
        """Take in the wheels' angles, in rad, ``seconds`` after the last time."""
        ticks = (math.floor(left / math.tau * TICKS), math.floor(right / math.tau * TICKS))
        before, self._ticks = self._ticks or ticks, ticks
        driven = [radius * (b - a) * math.tau / TICKS for radius, a, b in zip(self._radii, before, ticks, strict=True)]
        forward = float(driven[0] + driven[1]) / 2
        turned = float((driven[1] - driven[0]) / self._track)
        middle = self.pose.heading + turned / 2
        self.pose = Pose(
            self.pose.x + forward * math.cos(middle),
            self.pose.y + forward * math.sin(middle),
            math.remainder(self.pose.heading + turned, math.tau),
        )
        if seconds > 0:
            self.speed = forward / seconds
            self.turn = turned / seconds
