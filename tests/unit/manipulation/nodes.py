"""What the example's processes meet in tests: a gate that lets a standby's commands through when others have ended."""

from __future__ import annotations

import contextlib
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

ROBOT, HELD = "/arm_controller/joint_trajectory", "/held/joint_trajectory"

SILENCE = 0.3
"""s without commands after which it opens, once there have been some."""


def gate() -> None:
    node = Node("gate")
    out = node.create_publisher(JointTrajectory, ROBOT, 10)
    last = [0.0]
    opened = [False]

    def heard(message: JointTrajectory) -> None:
        if not opened[0]:
            last[0] = time.monotonic()

    def held(message: JointTrajectory) -> None:
        opened[0] = opened[0] or 0 < last[0] < time.monotonic() - SILENCE
        if opened[0]:
            out.publish(message)

    node.create_subscription(JointTrajectory, ROBOT, heard, 10)
    node.create_subscription(JointTrajectory, HELD, held, 10)
    print('{"event":"ready"}', flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        gate()
