"""Runs the robot: ``python -m manipulation_robot``. ROBOT_LOG says where the log goes."""

from __future__ import annotations

import os

import rclpy
from navigation_robot.journal import Journal

from manipulation_robot.robot import Robot


def main() -> None:
    """Run the robot until it is told to stop."""
    rclpy.init()
    robot = Robot(Journal(os.environ.get("ROBOT_LOG")))
    try:
        robot.run()
    except KeyboardInterrupt:
        pass
    except Exception:
        if rclpy.ok():  # otherwise a signal ended ROS in the middle of a tick
            raise
    finally:
        robot.close()


if __name__ == "__main__":
    main()
