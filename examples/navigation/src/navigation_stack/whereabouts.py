"""Where the robot is on the map: the last result of localization, carried on by odometry."""

from __future__ import annotations

import math

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.qos import QoSProfile

from navigation_stack.conversions import pose_of, seconds
from navigation_stack.managed import LATCHED, Input, Managed
from navigation_stack.poses import Odometry, Pose

ODOMETRY = QoSProfile(depth=50)
"""Deep enough for what comes between two looks."""


class OdometryInput:
    """The robot's odometry."""

    def __init__(self, node: Managed) -> None:
        self._input: Input[OdometryMessage] = node.input(OdometryMessage, "/odom", ODOMETRY)
        self.history = Odometry()
        self.speed = 0.0
        """As it was last said, in m/s."""

    def take(self) -> None:
        """Take in what has come."""
        for message in self._input.taken():
            self.history.add(seconds(message.header.stamp), pose_of(message.pose.pose))
            self.speed = message.twist.twist.linear.x


class Whereabouts:
    """Where the robot is now."""

    def __init__(self, node: Managed, *, odometry: bool = True) -> None:
        self._poses: Input[PoseWithCovarianceStamped] = node.input(PoseWithCovarianceStamped, "/amcl_pose", LATCHED)
        self._odometry = OdometryInput(node) if odometry else None
        self._pending: tuple[float, Pose] | None = None
        self._origin: Pose | None = None
        self._last: tuple[float, Pose] | None = None

    @property
    def speed(self) -> float:
        """As odometry last said it, in m/s."""
        return self._odometry.speed if self._odometry else 0.0

    def take(self) -> None:
        """Take in what has come."""
        if self._odometry:
            self._odometry.take()
        for message in self._poses.taken():
            self._pending = self._last = seconds(message.header.stamp), pose_of(message.pose.pose)
        if self._pending and self._odometry:
            then = self._odometry.history.at(self._pending[0])
            if then is not None:
                self._origin = self._pending[1].then(then.inverse())
                self._pending = None

    def age(self, now: float) -> float:
        """s since the older of the last result of localization and the last odometry; infinite without either."""
        latest = self._odometry.history.latest if self._odometry else self._last
        return now - min(latest[0], self._last[0]) if latest and self._last else math.inf

    @property
    def pose(self) -> Pose | None:
        """The pose on the map; None as long as it is not known."""
        if self._odometry is None:
            return self._last[1] if self._last else None
        latest = self._odometry.history.latest
        if self._origin is None or latest is None:
            return self._last[1] if self._last else None
        return self._origin.then(latest[1])
