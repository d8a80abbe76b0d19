"""The tracker's node: subscribes to images and their calibration, and publishes poses and odometry."""

from __future__ import annotations

import logging
import math
import re
import time
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from understudy.kinematics.velocities import Velocity
from understudy.ros.runtime.node_options import own_context, plain_node
from understudy.tracker import camera_calibration
from understudy.tracker.camera_device import Footage
from understudy.tracker.configuration import Configuration
from understudy.tracker.floor_projection import FloorPose
from understudy.tracker.image_messages import Gray, Unusable, calibration, gray
from understudy.tracker.robot_location import DetectedRobot, Locator

_logger = logging.getLogger(__name__)

SAY_AGAIN = 30.0
"""Seconds after which a problem that persists is logged again."""

WITHOUT_IMAGE = 20
"""Number of calibrations without an image after which missing images are reported. One calibration comes with each
image."""

_FIGURE = re.compile(r"[0-9.]+")
"""The parts of a problem's text that differ between images while the problem is the same."""

FIXED = 1e-6
"""Variance of motions that a robot on the floor cannot make, such as flying: m2, rad2, and the same for speeds."""


class Tracker:
    """Joins the ROS graph. It works only while :meth:`turn` is called."""

    def __init__(self, configuration: Configuration, *, context: Context | None = None) -> None:
        """Join in a given context, or in one of its own.

        Raises ConfigurationError if a device's calibration cannot be used.
        """
        self._locator = Locator(configuration)
        self._camera = configuration.camera
        device = configuration.camera.device
        known = camera_calibration.read(Path(device.calibration)) if device is not None else None
        self._context = context or own_context()
        self.node = plain_node("understudy_tracker", self._context)
        self._publishers: dict[int, tuple[Any, Any]] = {
            marker.id: (
                self.node.create_publisher(PoseWithCovarianceStamped, f"{marker.base}/pose", 10),
                self.node.create_publisher(Odometry, f"{marker.base}/odometry", 10),
            )
            for marker in configuration.markers
        }
        self._device: Footage | None = None
        if device is not None and known is not None:
            self._locator.calibrate(known)
            self._device = Footage(device, (known.width, known.height))
        else:
            self._subscribe()
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._reported_at: dict[str, float] = {}
        self._placed = self._locator.view is not None
        self._info: tuple[Any, ...] | None = None
        self._without_image = 0

    def _subscribe(self) -> None:
        # A best-effort reader matches every camera. Only the newest image is useful.
        reliability = ReliabilityPolicy.RELIABLE if self._camera.reliable else ReliabilityPolicy.BEST_EFFORT
        newest = QoSProfile(depth=1, reliability=reliability)
        self.node.create_subscription(Image, self._camera.source, self.on_image, newest)
        self.node.create_subscription(CameraInfo, self._camera.calibration, self.on_calibration, newest)

    def turn(self, timeout: float) -> None:
        """Process what has arrived, or wait for something for ``timeout`` seconds."""
        if self._device is None:
            self._executor.spin_once(timeout_sec=timeout)
            return
        try:
            frame = self._device.take(timeout)
        except Unusable as error:
            self._problem(str(error))
            return
        if frame is not None:
            seconds, rest = divmod(frame.stamp, 1_000_000_000)
            self._see(frame.image, Time(sec=seconds, nanosec=rest))

    def close(self) -> None:
        """Leave the graph, and close the camera."""
        if self._device is not None:
            self._device.close()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def on_calibration(self, message: Any) -> None:
        """Apply a calibration (sensor_msgs/msg/CameraInfo)."""
        self._without_image += 1
        if self._without_image >= WITHOUT_IMAGE:
            self._problem(self._no_images())
        # A calibration comes with each image, and is nearly always the same.
        info = (message.width, message.height, message.distortion_model, tuple(message.k), tuple(message.d))
        if info == self._info:
            return
        try:
            self._locator.calibrate(calibration(message))
        except Unusable as error:
            self._problem(f"the calibration on {self._camera.calibration} cannot be used: {error}")
            return
        self._info = info
        _logger.info("calibration of %d x %d pixels from %s", message.width, message.height, self._camera.calibration)

    def _no_images(self) -> str:
        text = f"calibrations arrive on {self._camera.calibration}, but no image on {self._camera.source}: "
        if self._camera.reliable:
            return f"{text}nobody publishes there, or only with reliability best effort, for which camera.reliable must be false"
        return f"{text}nobody publishes there, or large images are lost on the way, for which camera.reliable can be set to true"

    def on_image(self, message: Any) -> None:
        """Find the markers in an image (sensor_msgs/msg/Image), and publish the poses of the robots."""
        self._without_image = 0
        stamp = message.header.stamp
        if not stamp.sec and not stamp.nanosec:
            self._problem(f"the images on {self._camera.source} have no stamp: the time of their receipt is taken")
            stamp = self.node.get_clock().now().to_msg()
        try:
            image = gray(message)
        except Unusable as error:
            self._problem(self._unusable(error))
            return
        self._see(image, stamp)

    def _unusable(self, error: Unusable) -> str:
        return f"an image {'of' if self._device is not None else 'on'} {self._camera.source} cannot be used: {error}"

    def _see(self, image: Gray, stamp: Any) -> None:
        try:
            sightings = self._locator.see(image, stamp.sec + stamp.nanosec * 1e-9)
        except Unusable as error:
            self._problem(self._unusable(error))
            return
        for problem in self._locator.problems:
            self._problem(problem)
        if self._locator.view is not None and not self._placed:
            self._placed = True
            x, y, z = self._locator.view.place
            _logger.info("the camera is at %.3f %.3f %.3f m by its references", x, y, z)
        for sighting in sightings:
            self._publish(sighting, stamp)

    def _publish(self, sighting: DetectedRobot, stamp: Any) -> None:
        on_pose, on_odometry = self._publishers[sighting.marker.id]
        on_pose.publish(pose_of(sighting, self._camera.frame, stamp))
        if (odometry := odometry_of(sighting, self._camera.frame, stamp)) is not None:
            on_odometry.publish(odometry)

    def _problem(self, text: str) -> None:
        """Log a problem, but not with every image."""
        now, kind = time.monotonic(), _FIGURE.sub("", text)
        if now - self._reported_at.get(kind, float("-inf")) >= SAY_AGAIN:
            self._reported_at = {kind: when for kind, when in self._reported_at.items() if now - when < SAY_AGAIN}
            self._reported_at[kind] = now
            _logger.warning("%s", text)


def pose_of(sighting: DetectedRobot, frame: str, stamp: Any) -> Any:
    """Return the pose of a robot as geometry_msgs/PoseWithCovarianceStamped; ``stamp`` as in a header."""
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = stamp, frame
    _fill_pose(message.pose, sighting.placed)
    return message


def odometry_of(sighting: DetectedRobot, frame: str, stamp: Any) -> Any | None:
    """Return the same with its velocity, as nav_msgs/Odometry; None while the velocity is not known."""
    if sighting.velocity is None:
        return None
    message = Odometry()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.child_frame_id = sighting.marker.frame or sighting.marker.name
    _fill_pose(message.pose, sighting.placed)
    _fill_twist(message.twist, sighting.velocity)
    return message


def _fill_pose(message: Any, placed: FloorPose) -> None:
    message.pose.position.x, message.pose.position.y = placed.x, placed.y
    message.pose.orientation.z = math.sin(placed.heading / 2)
    message.pose.orientation.w = math.cos(placed.heading / 2)
    covariance = _diagonal()
    for row, place in enumerate((0, 1, 5)):
        for column, other in enumerate((0, 1, 5)):
            covariance[6 * place + other] = float(placed.covariance[row, column])
    message.covariance = covariance


def _fill_twist(message: Any, velocity: Velocity) -> None:
    message.twist.linear.x, message.twist.linear.y = velocity.forward, velocity.left
    message.twist.angular.z = velocity.turn
    covariance = _diagonal()
    for row in range(2):
        for column in range(2):
            covariance[6 * row + column] = velocity.covariance[row][column]
    covariance[35] = velocity.turn_variance
    message.covariance = covariance


def _diagonal() -> list[float]:
    return [FIXED if index % 7 == 0 else 0.0 for index in range(36)]
