"""The application of ``understudy try``: drives the robot round in a circle, by its odometry.

An ordinary ROS 2 node. It does not know whether it is in control: a standby runs the same code and sends as many commands. Each command
has the name of its sender in its frame, which the robot has no other use for. Run as
``python -m understudy.cli.local_demo.application NAME``.
"""

from __future__ import annotations

import math
import sys

from understudy.cli.local_demo.robot import COMMANDS, ODOMETRY, RADIUS

HERTZ = 20
"""Commands in a second."""

SPEED = 0.4
"""In m/s."""


def turn_rate(x: float, y: float, heading: float) -> float:
    """Return the angular velocity (rad/s) that keeps a robot on its circle around the origin, or brings it back there."""
    distance = math.hypot(x, y)
    along = math.atan2(y, x) + math.pi / 2
    wanted = along + math.atan(distance - RADIUS)
    error = math.remainder(wanted - heading, 2 * math.pi)
    return max(-1.5, min(1.5, SPEED / RADIUS + 2.0 * error))


def main(arguments: list[str]) -> None:
    """Run until the process is ended."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import Odometry

    rclpy.init()
    (name,) = arguments
    node = rclpy.create_node("drive")
    commands = node.create_publisher(TwistStamped, COMMANDS, 10)
    newest: list[Odometry] = []

    def moved(message: Odometry) -> None:
        newest[:] = [message]

    def drive() -> None:
        if not newest:
            return
        pose = newest[0].pose.pose
        command = TwistStamped()
        command.header.stamp = node.get_clock().now().to_msg()
        command.header.frame_id = name
        command.twist.linear.x = SPEED
        command.twist.angular.z = turn_rate(
            pose.position.x, pose.position.y, 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        )
        commands.publish(command)

    node.create_subscription(Odometry, ODOMETRY, moved, 1)
    node.create_timer(1 / HERTZ, drive)
    rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1:])
