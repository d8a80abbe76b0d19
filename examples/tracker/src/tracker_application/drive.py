"""The node that decides: by /odom, it says on cmd_vel_nav how fast to drive and turn, as Nav2's controller does."""

from __future__ import annotations

import math
import time

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from tracker_application.route import Route

PERIOD = 0.05
"""Seconds between commands."""


class Drive(Node):
    """Follows the route once it knows where the robot is."""

    def __init__(self, name: str) -> None:
        super().__init__("drive")
        self._name = name
        self._route = Route()
        self._pose: tuple[float, float, float] | None = None
        # Of a stream of commands only the latest one is worth sending again.
        self._commands = self.create_publisher(TwistStamped, "cmd_vel_nav", 10)
        self.create_subscription(Odometry, "odom", self._moved, 1)
        self.create_timer(PERIOD, self._decide)

    def _moved(self, message: Odometry) -> None:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        self._pose = place.x, place.y, 2 * math.atan2(turn.z, turn.w)

    def _decide(self) -> None:
        if self._pose is None:
            return
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._name
        message.twist.linear.x, message.twist.angular.z = self._route.command(*self._pose, time.monotonic())
        self._commands.publish(message)
