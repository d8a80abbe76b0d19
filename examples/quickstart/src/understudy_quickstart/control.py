"""Drives the robot along the plan: the last of three nodes of which each depends on the one before (see examples/dependent).

Without a plan it gives no commands, and the robot stops by itself.
"""

from __future__ import annotations

import math
import os
import socket
import time

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from understudy_quickstart.kinematics import Pose
from understudy_quickstart.pursuit import Circuit, Point, Pursuit, space_ahead
from understudy_quickstart.running import FRESH, run


class Control(Node):
    """Publishes /cmd_vel 20 times a second while /plan comes."""

    def __init__(self, name: str) -> None:
        super().__init__("control")
        self._name = name
        self._points: tuple[Point, ...] = ()
        self._pursuit: Pursuit | None = None
        self._received = 0.0
        self._pose: Pose | None = None
        self._ahead: float | None = None
        self._commands = self.create_publisher(TwistStamped, "/cmd_vel", 10)
        self.create_subscription(Path, "/plan", self._planned, 1)
        self.create_subscription(Odometry, "/odom", self._moved, 1)
        self.create_subscription(LaserScan, "/scan", self._scanned, qos_profile_sensor_data)
        self.create_timer(1 / 20, self._drive)

    def _planned(self, message: Path) -> None:
        self._received = time.monotonic()
        points = tuple((one.pose.position.x, one.pose.position.y) for one in message.poses)
        if points != self._points and len(points) > 1:
            self._points, self._pursuit = points, Pursuit(Circuit(points))

    def _moved(self, message: Odometry) -> None:
        turn, position = message.pose.pose.orientation, message.pose.pose.position
        self._pose = Pose(position.x, position.y, 2 * math.atan2(turn.z, turn.w))

    def _scanned(self, message: LaserScan) -> None:
        self._ahead = space_ahead(message.ranges, message.angle_min, message.angle_increment)

    def _drive(self) -> None:
        if self._pursuit is None or self._pose is None or self._ahead is None:
            return
        if time.monotonic() - self._received > FRESH:
            return
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._name
        message.twist.linear.x, message.twist.angular.z = self._pursuit.command(self._pose, self._ahead)
        self._commands.publish(message)


def main() -> None:
    """Run the node until it is asked to stop."""
    run(lambda: Control(os.environ.get("HOSTNAME") or socket.gethostname()))


if __name__ == "__main__":
    main()
