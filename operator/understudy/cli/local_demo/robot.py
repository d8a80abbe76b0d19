"""The simulated robot of ``understudy try``: drives as it is commanded, publishes odometry, and records every command that reaches it.

It has no DDS profile, as any robot behind a mux. Run as ``python -m understudy.cli.local_demo.robot JOURNAL``.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

from understudy.cli.local_demo.journals import JournalWriter

COMMANDS, ODOMETRY = "/try/cmd_vel", "/try/odom"
"""Topics of its own, so that no real robot receives these commands, even if somebody starts one in this ROS domain meanwhile."""

TYPE = "geometry_msgs/msg/TwistStamped"

NAMESPACE, WORKLOAD = "try", "robot"
"""What the monitor and the mux call the workload of this robot."""

PERIOD = 0.05
"""Seconds between two steps of the simulation, each with an odometry message."""

WATCHDOG = 0.5
"""Seconds after the last command at which the robot stops by itself, as real bases do."""

RADIUS = 1.0
"""Distance of the robot from the origin at its start, in m."""


class Base:
    """A base with two wheels. The journal gets each command with its sender, each stop of the watchdog, and positions."""

    def __init__(self, journal: JournalWriter) -> None:
        self._journal = journal
        self.x, self.y, self.heading = RADIUS, 0.0, math.pi / 2
        self._linear = self._angular = 0.0
        self._commanded = -math.inf
        self._steps = 0

    def command(self, linear: float, angular: float, source: str) -> None:
        """Drive with these velocities (m/s, rad/s) from now on."""
        self._journal.write(source=source)
        self._linear, self._angular, self._commanded = linear, angular, time.monotonic()

    def step(self) -> None:
        """Simulate one period."""
        if self._linear and time.monotonic() - self._commanded > WATCHDOG:
            self._linear = self._angular = 0.0
            self._journal.write(stopped=True)
        self.heading += self._angular * PERIOD
        self.x += self._linear * PERIOD * math.cos(self.heading)
        self.y += self._linear * PERIOD * math.sin(self.heading)
        self._steps += 1
        if self._steps % 5 == 0:
            self._journal.write(x=round(self.x, 3), y=round(self.y, 3), speed=round(self._linear, 3))


def main(arguments: list[str]) -> None:
    """Run until the process is ended."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import Odometry

    rclpy.init()
    node, base = rclpy.create_node("robot"), Base(JournalWriter(Path(arguments[0])))
    odometry = node.create_publisher(Odometry, ODOMETRY, 10)

    def commanded(message: TwistStamped) -> None:
        base.command(message.twist.linear.x, message.twist.angular.z, message.header.frame_id)

    def step() -> None:
        base.step()
        message = Odometry()
        message.header.stamp = node.get_clock().now().to_msg()
        message.pose.pose.position.x, message.pose.pose.position.y = base.x, base.y
        message.pose.pose.orientation.z = math.sin(base.heading / 2)
        message.pose.pose.orientation.w = math.cos(base.heading / 2)
        odometry.publish(message)

    node.create_subscription(TwistStamped, COMMANDS, commanded, 10)
    node.create_timer(PERIOD, step)
    rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1:])
