"""An application for a test, run in a pod: its commands show what it received.

It turns on the spot, and drives at the last speed that it received on /told; before the first one, at UNTOLD.
"""

from __future__ import annotations

import os

import rclpy
from geometry_msgs.msg import TwistStamped
from std_msgs.msg import Float32, String

UNTOLD = 0.01
"""Metres per second."""


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("drive")
    publisher = node.create_publisher(TwistStamped, "/cmd_vel", 1)
    speed = UNTOLD

    def told(message: Float32) -> None:
        nonlocal speed
        speed = message.data
        print(f"told {speed:.2f}", flush=True)

    def drive() -> None:
        command = TwistStamped()
        command.header.stamp = node.get_clock().now().to_msg()
        command.header.frame_id = os.environ["HOSTNAME"]
        command.twist.linear.x = speed
        command.twist.angular.z = 0.5
        publisher.publish(command)

    inputs = [
        node.create_subscription(Float32, "/told", told, 10),
        node.create_subscription(String, "/noted", lambda message: print(f"noted {message.data}", flush=True), 10),
    ]
    node.create_timer(0.05, drive)
    rclpy.spin(node)
    inputs.clear()


if __name__ == "__main__":
    main()
