"""``understudy tracker FILE``: the tracker's process. With ``--check`` it only checks whether the file can be used."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from pathlib import Path

from understudy.process import json_logs
from understudy.tracker.configuration import ConfigurationError, read

_logger = logging.getLogger(__name__)

TURN = 0.5
"""Seconds between checks of whether the process should end."""

NEEDS = {"cv2": "opencv-python-headless", "rclpy": "ros-jazzy-rclpy"}


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT.

    Returns 2 if the configuration is missing or wrong, or a package is not installed.
    """
    parser = argparse.ArgumentParser(
        prog="understudy tracker",
        description="Tracks robots with ArUco markers in the images of a camera, and publishes their poses and "
        "velocities as ROS topics. The leaf motion of a health tree can compare these with the robot's commands.",
        epilog="Exit status: 0 if a signal stopped the tracker, or if --check finds no mistake, 2 if the "
        "configuration is missing or wrong, or if a required package is not installed.",
    )
    parser.add_argument(
        "file", nargs="?", type=Path, default=os.environ.get("UNDERSTUDY_TRACKER"), metavar="FILE",
        help="configuration file with the camera and the markers (default: the file that the environment variable "
        "UNDERSTUDY_TRACKER names)",
    )  # fmt: skip
    parser.add_argument("--check", action="store_true", help="only check the configuration file")
    arguments = parser.parse_args(argv)
    if arguments.file is None:
        parser.error("give the configuration's FILE, or set UNDERSTUDY_TRACKER to it")
    try:
        configuration = read(Path(arguments.file))
        if (device := configuration.camera.device) is not None:
            from understudy.tracker import camera_calibration

            camera_calibration.read(Path(device.calibration))
    except ConfigurationError as error:
        print(error, file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        return _missing(error)
    if arguments.check:
        print(f"{arguments.file} can be used")
        return 0
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    try:
        from understudy.tracker.tracker_node import Tracker
    except ModuleNotFoundError as error:
        return _missing(error)
    stop_requested = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop_requested.set())
    import cv2

    cv2.setNumThreads(1)  # an image is small, so threads would cost more than they save
    tracker = Tracker(configuration)
    names = ", ".join(f"{marker.name} on {marker.base}" for marker in configuration.markers)
    _logger.info("tracking %s by %s", names, configuration.camera.source)
    try:
        while not stop_requested.is_set():
            tracker.turn(TURN)
    finally:
        tracker.close()
    _logger.info("ended")
    return 0


def _missing(error: ModuleNotFoundError) -> int:
    package = NEEDS.get(error.name or "", error.name)
    message = f"{package} is not installed: pip install '.[ros,tracker]' in understudy's repository"
    print(f"understudy tracker: {message}", file=sys.stderr)
    return 2
