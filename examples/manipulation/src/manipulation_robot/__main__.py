"""Runs the robot: ``python -m manipulation_robot``. ROBOT_LOG says where the log goes."""

from __future__ import annotations

import os

import rclpy
from navigation_robot.journal import Journal
from navigation_robot.running import until_stopped

from manipulation_robot.robot import Robot


def main() -> None:
    """Run the robot until it is asked to stop."""
    rclpy.init()
    until_stopped(Robot(Journal(os.environ.get("ROBOT_LOG"))))


if __name__ == "__main__":
    main()
