"""Runs the application: ``python -m tracker_application``. SIGUSR1 remaps the input of what talks to the robot, wrongly."""

from __future__ import annotations

import os
import signal
import socket

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from tracker_application.drive import Drive
from tracker_application.smoother import Smoother


def main() -> None:
    """Run until it is asked to stop."""
    rclpy.init()
    name = os.environ.get("HOSTNAME") or socket.gethostname()
    drive, smoother = Drive(name), Smoother(name)
    signal.signal(signal.SIGUSR1, lambda *_: smoother.misremap())
    executor = SingleThreadedExecutor()
    executor.add_node(drive)
    executor.add_node(smoother)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        if rclpy.ok():  # otherwise a signal ended ROS in the middle of a callback
            raise
    finally:
        drive.destroy_node()
        smoother.destroy_node()


if __name__ == "__main__":
    main()
