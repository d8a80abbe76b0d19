"""The robot follows the commands on /cmd_vel and publishes /odom; the camera above it publishes what it sees.

What it writes down goes to standard output, one JSON record a line: every command with its sender, and ten times a second
where it really is and how it moves. Which UDP port the reader of /cmd_vel listens on comes from the DDS profile that the
environment names.
"""

from __future__ import annotations

import array
import json
import math
import time

import cv2
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from tracker_scene import Pose, Scene
from tracker_scene.driving import Base
from tracker_scene.scene import CameraPlace

START = Pose(-0.6, -0.3, 0.0)
CAMERA = CameraPlace(z=2.0)
"""Over the middle of the floor; the world's x axis points to the image's right."""

SIZE = (480, 360)
"""Pixels. In a smaller image the marker is missed at one pose or another, and a robot may stand at just that one."""

TICK = 0.02
"""Seconds between two steps."""

MEASURE = 2
"""Ticks in the period of odometry: 25 Hz."""

LOOK = 5
"""Ticks in the period of the camera and of what is written down: 10 Hz."""

WATCHDOG = 0.5
"""Age in seconds at which a command counts no more (cmd_vel_timeout of ros2_controllers)."""

LATE = 2.0
"""Seconds that are caught up at most; a process that was stopped for longer goes on from where it was."""

IMAGES = "/ceiling/image_raw"
CALIBRATION = "/ceiling/camera_info"


class Robot:
    """A simulated robot and a camera, in real time.

    Stamps are by the simulation's own clock, which real time drags along: on a busy machine an image comes late, as from a
    real camera, and does not say that the robot was slower.
    """

    def __init__(self) -> None:
        self._scene = Scene(START, CAMERA, size=SIZE)
        self._base = Base(self._scene)
        self._node = Node("robot", start_parameter_services=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._odometry = self._node.create_publisher(Odometry, "/odom", 10)
        # An image is nearly as large as what a receiving socket holds: who asks for it to be sent again gets all of them.
        newest = QoSProfile(depth=2)
        self._images = self._node.create_publisher(Image, IMAGES, newest)
        self._calibration = self._node.create_publisher(CameraInfo, CALIBRATION, newest)
        self._node.create_subscription(TwistStamped, "/cmd_vel", self._commanded, 10)
        self._received = 0
        self._commanded_at = -math.inf
        self._held = True
        self._begun = 0.0
        """Unix time of the simulation's beginning."""

    def run(self) -> None:
        """Drive until ROS is shut down."""
        self._scene.image()  # the first one takes long
        offset = time.time() - time.monotonic()
        self._begun = time.time()
        ticks = 0
        while rclpy.ok():
            ahead = self._now() + TICK - offset - time.monotonic()
            if ahead > 0:
                self._executor.spin_once(timeout_sec=ahead)
                continue
            if ahead < -LATE:
                _record("late", time=self._now(), seconds=-ahead)
                self._begun -= ahead
            self._executor.spin_once(timeout_sec=0)
            self._watch()
            self._base.step(TICK)
            ticks += 1
            if ticks % MEASURE == 0:
                self._odometry.publish(self._measured())
            if ticks % LOOK == 0:
                self._look()
                self._log()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._scene.close()

    def _now(self) -> float:
        return self._begun + self._scene.time

    def _stamp(self) -> Time:
        seconds, rest = divmod(round(self._now() * 1e9), 1_000_000_000)
        return Time(sec=seconds, nanosec=rest)

    def _commanded(self, message: TwistStamped, info: dict[str, int]) -> None:
        linear, angular = message.twist.linear.x, message.twist.angular.z
        self._base.command(linear, angular)
        self._commanded_at = self._scene.time
        self._received += 1
        pose = self._scene.pose
        _record(
            "command",
            received=info["received_timestamp"] / 1e9,
            sequence=self._received,
            source=message.header.frame_id,
            sent=info["source_timestamp"] / 1e9,
            linear=linear,
            angular=angular,
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            speed=self._scene.motion[0],
        )

    def _watch(self) -> None:
        held = self._scene.time - self._commanded_at > WATCHDOG
        if held and not self._held:
            self._base.command(0.0, 0.0)
        self._held = held

    def _measured(self) -> Odometry:
        pose, (speed, turn) = self._scene.pose, self._scene.motion
        message = Odometry()
        message.header.stamp = self._stamp()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
        message.pose.pose.orientation = Quaternion(z=math.sin(pose.heading / 2), w=math.cos(pose.heading / 2))
        message.twist.twist.linear.x, message.twist.twist.angular.z = speed, turn
        return message

    def _look(self) -> None:
        pixels = cv2.cvtColor(self._scene.image(), cv2.COLOR_RGB2GRAY)
        image, info = Image(), CameraInfo()
        for message in (image, info):
            message.header.stamp = self._stamp()
            message.header.frame_id = "ceiling"
            message.width, message.height = SIZE
        image.encoding, image.step = "mono8", SIZE[0]
        # Of an array the message takes the bytes; it would look at every number of anything else.
        image.data = array.array("B", pixels.tobytes())
        info.distortion_model, info.d, info.k = "plumb_bob", [0.0] * 5, Scene.matrix(SIZE)
        self._calibration.publish(info)
        self._images.publish(image)

    def _log(self) -> None:
        pose, (speed, turn) = self._scene.pose, self._scene.motion
        _record(
            "odometry",
            time=self._now(),
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            speed=speed,
            turn=turn,
            held=self._held,
        )


def _record(event: str, **values: float | int | str | bool) -> None:
    rounded = {key: round(value, 6) if isinstance(value, float) else value for key, value in values.items()}
    print(json.dumps({"event": event} | rounded, separators=(",", ":")), flush=True)
