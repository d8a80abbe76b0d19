"""Runs the robot: ``python -m navigation_robot``. NAVIGATION_SEED says in which world, ROBOT_LOG where the log goes."""

from __future__ import annotations

import os

import rclpy
from navigation_world import generate

from navigation_robot.journal import Journal
from navigation_robot.robot import Robot
from navigation_robot.running import until_stopped


def main() -> None:
    """Run the robot until it is asked to stop."""
    rclpy.init()
    until_stopped(Robot(generate(int(os.environ.get("NAVIGATION_SEED", "7"))), Journal(os.environ.get("ROBOT_LOG"))))


if __name__ == "__main__":
    main()
