"""Shapes and poses in the plane. Lengths in m, angles in rad, counter-clockwise from the x axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where something stands and where it looks to."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Rectangle:
    """An axis-aligned part of the plane."""

    left: float
    bottom: float
    right: float
    top: float

    @property
    def width(self) -> float:
        """Along x."""
        return self.right - self.left

    @property
    def depth(self) -> float:
        """Along y."""
        return self.top - self.bottom


@dataclass(frozen=True, slots=True)
class Box:
    """A box on the floor: its middle, half of its sides, and how it is turned."""

    x: float
    y: float
    half_width: float
    half_depth: float
    heading: float = 0.0
    height: float = 0.5

    def distance(self, x: Array, y: Array) -> Array:
        """How far each point is from the box; negative inside."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        along = np.abs((x - self.x) * cos + (y - self.y) * sin) - self.half_width
        across = np.abs((y - self.y) * cos - (x - self.x) * sin) - self.half_depth
        outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
        return outside + np.minimum(np.maximum(along, across), 0.0)


@dataclass(frozen=True, slots=True)
class Pillar:
    """A round thing on the floor."""

    x: float
    y: float
    radius: float
    height: float = 0.5

    def distance(self, x: Array, y: Array) -> Array:
        """How far each point is from the pillar; negative inside."""
        return np.hypot(x - self.x, y - self.y) - self.radius


Shape = Box | Pillar


def clearance(shapes: tuple[Shape, ...], x: Array, y: Array) -> Array:
    """How far the nearest of the shapes is from each point; negative inside of one."""
    nearest = np.full(np.broadcast(x, y).shape, np.inf)
    for shape in shapes:
        np.minimum(nearest, shape.distance(x, y), out=nearest)
    return nearest
