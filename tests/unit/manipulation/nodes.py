"""What the example's processes meet in tests: a gate that holds a standby's commands back until a file says otherwise."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory


def gate(opened: Path) -> None:
    node = Node("gate")
    out = node.create_publisher(JointTrajectory, "/arm_controller/joint_trajectory", 10)

    def held(message: JointTrajectory, info: dict[str, int]) -> None:
        # What was sent before is dropped, as a NetworkPolicy drops it; it may have waited here on a busy machine.
        if opened.exists() and info["source_timestamp"] >= opened.stat().st_mtime_ns:
            out.publish(message)

    node.create_subscription(JointTrajectory, "/held/joint_trajectory", held, 10)
    print('{"event":"ready"}', flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        gate(Path(sys.argv[1]))
