"""Has the arm take poses: ``python -m manipulation_client --goals 6``.

One JSON record a line goes to standard output and to the file that MANIPULATION_CLIENT_LOG names; the exit status is 0 when
every goal succeeded.
"""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

import rclpy
from manipulation_arm import Pose, places
from manipulation_interfaces.action import MoveToPose
from navigation_client.client import Client, Patience
from navigation_robot.journal import Journal
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import remove_ros_args


class Poser(Client):
    """Works through a list of poses."""

    NAME, ACTION, TYPE = "manipulation_client", "/move_to_pose", MoveToPose

    def described(self, goal: Pose) -> dict[str, float]:
        return {"x": goal.x, "y": goal.y, "z": goal.z}

    def message(self, goal: Pose) -> Any:
        message = MoveToPose.Goal()
        message.pose.header.frame_id = "base_link"
        message.pose.header.stamp = self._node.get_clock().now().to_msg()
        place, turned = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = goal.x, goal.y, goal.z
        turned.w, turned.x, turned.y, turned.z = goal.qw, goal.qx, goal.qy, goal.qz
        return message


def main() -> int:
    """Send the goals; returns the exit status."""
    parser = argparse.ArgumentParser(prog="manipulation_client", description=__doc__)
    parser.add_argument("--goals", type=int, default=6, help="how many")
    parser.add_argument("--within", type=float, default=300.0, help="seconds that a goal may take")
    parser.add_argument("--wait", type=float, default=120.0, help="seconds to wait for the server and for acceptance")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    patience = Patience(server=options.wait, acceptance=options.wait, result=options.within)
    client = Poser(Journal(os.environ.get("MANIPULATION_CLIENT_LOG")), patience)
    try:
        return 0 if client.run(list(places(options.goals))) else 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 1
    finally:
        client.close()


if __name__ == "__main__":
    sys.exit(main())
