"""Runs the robot and the camera: ``python -m tracker_robot``."""

from __future__ import annotations

import cv2
import rclpy
from rclpy.executors import ExternalShutdownException

from tracker_robot.robot import Robot


def main() -> None:
    """Run until it is asked to stop."""
    cv2.setNumThreads(1)  # an image is small; threads would cost more than they save
    rclpy.init()
    robot = Robot()
    try:
        robot.run()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        if rclpy.ok():  # otherwise a signal ended ROS in the middle of a tick
            raise
    finally:
        robot.close()


if __name__ == "__main__":
    main()
