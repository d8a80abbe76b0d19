"""Poses of the gripper, and those that the example's client wants it to take."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple


class Pose(NamedTuple):
    """A place in m in the frame of the arm's foot, and an orientation as a quaternion of length 1."""

    x: float
    y: float
    z: float
    qw: float = 1.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0


def reaching(x: float, y: float, z: float, pitch: float) -> Pose:
    """A pose away from the foot, with the gripper turned down by so many rad."""
    yaw = math.atan2(y, x)
    cy, sy, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return Pose(x, y, z, cy * cp, -sy * sp, cy * sp, sy * cp)


_PLACES = (
    reaching(0.22, -0.30, 0.16, 0.7),
    reaching(0.24, 0.28, 0.18, 0.7),
    reaching(-0.05, -0.36, 0.22, 0.5),
    reaching(0.30, 0.20, 0.30, 0.3),
    reaching(0.34, -0.16, 0.12, 1.0),
    reaching(-0.10, 0.33, 0.26, 0.6),
)
"""To and fro beside the post, over the box, near the table and away from it."""


def places(count: int) -> Iterator[Pose]:
    """So many poses, one after the other; they come again and again."""
    return itertools.islice(itertools.cycle(_PLACES), count)
