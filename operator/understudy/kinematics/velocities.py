"""How fast a body moves over the floor, from where it was seen recently.

A velocity is the slope of a straight line through the poses of a short window, by weighted least squares; what is said
of its uncertainty follows from that of the poses. If they do not lie on a line as well as they should, since the
body has changed its speed meanwhile, the uncertainty grows by how badly they do (the Birge ratio: R. T. Birge, Phys.
Rev. 40, 1932).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

LEAST = 3
"""Minimum number of poses in a window for a velocity: two always lie on a line, and show nothing about the fit."""

FULL = 0.5
"""The part of the window that the poses must span at least, so that a body that has just come into sight has no velocity yet."""


class Position(NamedTuple):
    """Where a body was seen on the floor."""

    stamp: float
    """When, in seconds of whatever clock."""
    x: float
    y: float
    """m"""
    heading: float
    """rad"""
    variances: tuple[float, float, float]
    """Of x and y in m2, and of the heading in rad2."""


class Velocity(NamedTuple):
    """The mean velocity over a window, in the body's own frame (REP 103: x forward, y to the left)."""

    forward: float
    left: float
    """m/s"""
    turn: float
    """rad/s, counter-clockwise"""
    covariance: tuple[tuple[float, float], tuple[float, float]]
    """Of forward and left, in m2/s2."""
    turn_variance: float
    """rad2/s2"""


class Velocities:
    """The poses of one body within a window."""

    def __init__(self, window: float) -> None:
        """``window`` in seconds."""
        self._window = window
        self._poses: deque[Position] = deque()

    def add(self, seen: Position) -> Velocity | None:
        """Note where the body was seen, and say how fast it moves; None if too little has been seen.

        A stamp that is not later than the last one begins again: its clock was set, or the images come from the start again.
        """
        poses = self._poses
        if poses and seen.stamp <= poses[-1].stamp:
            poses.clear()
        if poses:  # on from the last heading, so that the line has no step in it where the angle begins again
            before = poses[-1].heading
            seen = seen._replace(heading=before + math.remainder(seen.heading - before, math.tau))
        poses.append(seen)
        # A stamp is rounded to whatever its clock counts in.
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
        # A doubt in the heading swaps a part of the one for the other.
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
    """Of the slope."""
    mean: float
    mean_variance: float


def _line(times: Sequence[float], values: Sequence[float], variances: Sequence[float]) -> _Line:
    """The line through values by weighted least squares."""
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
