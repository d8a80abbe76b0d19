"""Poses in space, their composition, and the covariance of the result.

Metres and radians, in right-handed frames (REP 103); orientations are unit quaternions x, y, z, w. A pose is the place of a body in a
frame, and equally the transform from the body's frame into that frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

DRIFT = 0.05
"""Standard deviation of odometry, as a fraction of the distance and of the angle that it reports."""

DRIFT_IN_HEADING = 0.02
"""Additional standard deviation of each angle, in rad per metre: wheels of different sizes turn a robot that is meant to drive straight."""

ROUNDING = 1e-6
"""Variance, in m² or rad², below which the sign is a matter of rounding. An estimator that is certain may publish less than nothing: Nav2's
AMCL gives -1e-11 while the robot stands, and computes NaN when it receives that."""

_UNIT = 0.1
"""Maximum difference of a quaternion's length from 1. A rounded quaternion is normalized; any other is refused."""

Vector = tuple[float, float, float]


class Pose(NamedTuple):
    """A place and an orientation."""

    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Pose:
        """Return the pose of a place and a quaternion, which is normalized. Raises ValueError if the values are not a pose."""
        if len(values) != 7 or not all(map(math.isfinite, values)):
            raise ValueError(
                f"{list(values)} is not a pose: a pose has seven finite numbers (position x, y, z and quaternion x, y, z, w)"
            )
        length = math.hypot(*values[3:])
        if abs(length - 1.0) > _UNIT:
            raise ValueError(f"the quaternion {list(values[3:])} is not a rotation: its length is {length:.3g}, not 1")
        return cls(*values[:3], *(value / length for value in values[3:]))

    @property
    def place(self) -> Vector:
        """The position in m."""
        return self.x, self.y, self.z

    @property
    def angle(self) -> float:
        """The angle of its rotation in its frame, about any axis, from 0 to pi."""
        return 2.0 * math.atan2(math.hypot(self.qx, self.qy, self.qz), abs(self.qw))

    def turned(self, vector: Vector) -> Vector:
        """Return a vector of the body's frame in the outer frame."""
        x, y, z, w = self[3:]
        vx, vy, vz = vector
        # v + 2 q x (q x v + w v), which equals q v q* without the products that cancel each other
        tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
        return (
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        )

    def then(self, step: Pose) -> Pose:
        """Return a pose, which is given in this pose's frame, in the outer frame."""
        dx, dy, dz = self.turned(step.place)
        ax, ay, az, aw = self[3:]
        bx, by, bz, bw = step[3:]
        turned = (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )
        length = math.hypot(*turned)  # rounding would add up over many steps
        return Pose(self.x + dx, self.y + dy, self.z + dz, *(value / length for value in turned))

    def inverse(self) -> Pose:
        """Return the inverse transform."""
        back = Pose(0.0, 0.0, 0.0, -self.qx, -self.qy, -self.qz, self.qw)
        x, y, z = back.turned(self.place)
        return back._replace(x=-x, y=-y, z=-z)

    def to(self, other: Pose) -> Pose:
        """Return another pose of the same frame relative to this one."""
        return self.inverse().then(other)

    def distance(self, other: Pose) -> float:
        """Return the distance between the places in m."""
        return math.dist(self.place, other.place)

    def towards(self, other: Pose, part: float) -> Pose:
        """Return the pose at a fraction (0 to 1) of the way to the other, on a straight line and with a uniform turn by the shorter way."""
        step = self.to(other)
        sine = math.hypot(step.qx, step.qy, step.qz)
        half = math.atan2(sine, abs(step.qw))
        scale = math.copysign(math.sin(part * half) / sine, step.qw) if sine else 0.0
        turn = Pose(0.0, 0.0, 0.0, step.qx * scale, step.qy * scale, step.qz * scale, math.cos(part * half))
        x, y, z = (a + part * (b - a) for a, b in zip(self.place, other.place, strict=True))
        return self.then(turn)._replace(x=x, y=y, z=z)


HERE = Pose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""A frame's own origin."""


def carried(kept: Pose, then: Pose, now: Pose) -> Pose:
    """Return a kept pose of a body, moved as the body has moved since.

    ``then`` and ``now`` are the poses of odometry at the time of the kept pose and now. Only the motion between them counts, in the body's
    own frame. The origin of odometry has no effect.
    """
    return kept.then(then.to(now))


def grown(covariance: Sequence[float], kept: Pose, present: Pose, *, driven: float, turned: float) -> list[float]:
    """Return the covariance of a pose that was propagated from ``kept`` to ``present``, over ``driven`` metres and ``turned`` radians.

    Row by row, for x, y, z and the rotations about the fixed axes, as in geometry_msgs/msg/PoseWithCovariance. Uncertainty of the
    orientation becomes uncertainty of the place, in proportion to the distance. The uncertainty of odometry itself (DRIFT) is added. A
    covariance that is marked as unknown (a negative variance) stays as it is. What a planar robot has (x, y, yaw) is at least ROUNDING.
    """
    if len(covariance) != 36 or any(covariance[7 * i] < -ROUNDING for i in range(6)):
        return list(covariance)
    dx, dy, dz = (b - a for a, b in zip(kept.place, present.place, strict=True))
    lever = ((0.0, dz, -dy), (-dz, 0.0, dx), (dy, -dx, 0.0))  # effect of a small turn on a place at that distance
    jacobian = [[float(i == j) for j in range(6)] for i in range(6)]
    for i in range(3):
        jacobian[i][3:] = lever[i]
    certain = {i for i in range(6) if covariance[7 * i] <= 0}
    before = [[0.0 if {i, j} & certain else covariance[6 * i + j] for j in range(6)] for i in range(6)]
    half = [[sum(jacobian[i][k] * before[k][j] for k in range(6)) for j in range(6)] for i in range(6)]
    after = [[sum(half[i][k] * jacobian[j][k] for k in range(6)) for j in range(6)] for i in range(6)]
    place, turn = (DRIFT * driven) ** 2, (DRIFT * turned + DRIFT_IN_HEADING * driven) ** 2
    for i in range(6):
        # Driving adds no uncertainty to components that have none in a planar robot (z, roll and pitch).
        if before[i][i] > 0 or i in (0, 1, 5):
            after[i][i] += place if i < 3 else turn
        if i in (0, 1, 5):
            after[i][i] = max(after[i][i], ROUNDING)
    return [value for row in after for value in row]
