"""Estimates how fast a body moves over the floor from its recent positions.

A velocity is the slope of a straight line through the poses of a short window, by weighted least squares. Its uncertainty follows from that
of the poses. If the poses fit the line worse than expected, because the body has changed its speed, the uncertainty grows with the misfit
(the Birge ratio: R. T. Birge, Phys. Rev. 40, 1932).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

LEAST = 3
"""Minimum number of poses in a window for a velocity: two always lie on a line, and show nothing about the fit."""

FULL = 0.5
"""Minimum fraction of the window that the poses must span, so that a body that has just come into sight has no velocity yet."""


class Position(NamedTuple):
    """An observed position of a body on the floor."""

    stamp: float
    """Time in seconds of any clock."""
    x: float
    y: float
    """m"""
    heading: float
    """rad"""
    variances: tuple[float, float, float]
    """Variances of x and y in m2, and of the heading in rad2."""


class Velocity(NamedTuple):
    """The mean velocity over a window, in the body's own frame (REP 103: x forward, y to the left)."""

    forward: float
    left: float
    """m/s"""
    turn: float
    """rad/s, counter-clockwise"""
    covariance: tuple[tuple[float, float], tuple[float, float]]
    """Covariance of forward and left in m2/s2."""
    turn_variance: float
    """rad2/s2"""


class Velocities:
    """The poses of one body within a window."""

    def __init__(self, window: float) -> None:
        """``window`` in seconds."""
        self._window = window
        self._poses: deque[Position] = deque()

    def add(self, position: Position) -> Velocity | None:
        """Add a position and return the velocity; None if too little has been observed.

        A stamp that is not later than the last one starts a new window: the clock was set, or the images are replayed.
        """
        poses = self._poses
        if poses and position.stamp <= poses[-1].stamp:
            poses.clear()
        if poses:  # continue from the last heading, so that the line has no step where the angle wraps around
            before = poses[-1].heading
            position = position._replace(heading=before + math.remainder(position.heading - before, math.tau))
        poses.append(position)
        # Stamps are rounded to the resolution of their clock.
        while poses[-1].stamp - poses[0].stamp > self._window * (1 + 1e-6) + 1e-9:
            poses.popleft()
        if len(poses) < LEAST or poses[-1].stamp - poses[0].stamp < FULL * self._window:
            return None
        times = [pose.stamp - poses[0].stamp for pose in poses]
        x = _line(times, [pose.x for pose in poses], [pose.variances[0] for pose in poses])
        y = _line(times, [pose.y for pose in poses], [pose.variances[1] for pose in poses])
        heading = _line(times, [pose.heading for pose in poses], [pose.variances[2] for pose in poses])
        cos, sin = math.cos(heading.mean), math.sin(heading.mean)
        forward, left = cos * x.slope + sin * y.slope, -sin * x.slope + cos * y.slope
        # An error of the heading exchanges a part of forward for a part of left.
        covariance = (
            (
                cos * cos * x.variance + sin * sin * y.variance + left * left * heading.mean_variance,
                cos * sin * (y.variance - x.variance) - forward * left * heading.mean_variance,
            ),
            (
                cos * sin * (y.variance - x.variance) - forward * left * heading.mean_variance,
                sin * sin * x.variance + cos * cos * y.variance + forward * forward * heading.mean_variance,
            ),
        )
        return Velocity(forward, left, heading.slope, covariance, heading.variance)


class _Line(NamedTuple):
    slope: float
    variance: float
    """Variance of the slope."""
    mean: float
    mean_variance: float


def _line(times: Sequence[float], values: Sequence[float], variances: Sequence[float]) -> _Line:
    """Return the line through values by weighted least squares."""
    weights = [1.0 / variance for variance in variances]
    total = sum(weights)
    middle = sum(w * t for w, t in zip(weights, times, strict=True)) / total
    mean = sum(w * v for w, v in zip(weights, values, strict=True)) / total
    spread = sum(w * (t - middle) ** 2 for w, t in zip(weights, times, strict=True))
    slope = sum(w * (t - middle) * (v - mean) for w, t, v in zip(weights, times, values, strict=True)) / spread
    misses = sum(w * (v - mean - slope * (t - middle)) ** 2 for w, t, v in zip(weights, times, values, strict=True)) / (
        len(values) - 2
    )
    scale = max(1.0, misses)
    return _Line(slope, scale / spread, mean, scale / total)
