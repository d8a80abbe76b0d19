"""The instance on board of examples/navigation/on-board: it holds the robot where it is while the link to the cluster is down."""

from __future__ import annotations

from contextlib import suppress

import rclpy
from geometry_msgs.msg import Twist
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from navigation_robot.running import until_stopped

PERIOD = 0.1
"""Seconds between two commands."""


class Standstill:
    """Commands velocity zero, all the time."""

    def __init__(self) -> None:
        self._node = Node("standstill")
        commands = self._node.create_publisher(Twist, "/cmd_vel", 10)
        self._node.create_timer(PERIOD, lambda: commands.publish(Twist()))

    def run(self) -> None:
        """Command until ROS is shut down."""
        with suppress(ExternalShutdownException):
            rclpy.spin(self._node)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()


if __name__ == "__main__":
    rclpy.init()
    until_stopped(Standstill())
