"""The tracker as a process on real DDS: images and their calibration in, poses, odometry and the leaf's verdict out."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.unit.dds import isolate_discovery

OPERATOR = Path(__file__).parents[3] / "operator"
SPEED = 0.3
BEGIN = 1_000


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch) -> None:
    isolate_discovery(monkeypatch)


@pytest.fixture
def tracker(dds: None, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    from bench.tracker import CONFIGURATION

    file = tmp_path / "tracker.yaml"
    file.write_text(CONFIGURATION)
    environment = {**os.environ, "PYTHONPATH": str(OPERATOR)}
    process = subprocess.Popen(
        [sys.executable, "-m", "understudy.main", "tracker", str(file)],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    yield process
    process.kill()
    process.wait()
    assert process.stderr is not None
    process.stderr.close()


class Camera:
    """Publishes images, each until the tracker has answered it: nothing hangs on how fast this machine is."""

    def __init__(self, node: Any, turn: Any) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from nav_msgs.msg import Odometry
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo, Image

        self._turn = turn
        self._images = node.create_publisher(Image, "/camera/image_raw", qos_profile_sensor_data)
        self._infos = node.create_publisher(CameraInfo, "/camera/camera_info", qos_profile_sensor_data)
        self.poses: dict[int, Any] = {}
        self.odometry: dict[int, Any] = {}
        node.create_subscription(
            PoseWithCovarianceStamped, "/tracker/robot/pose", lambda message: self._keep(self.poses, message), 100
        )
        node.create_subscription(
            Odometry, "/tracker/robot/odometry", lambda message: self._keep(self.odometry, message), 100
        )

    @staticmethod
    def _keep(kept: dict[int, Any], message: Any) -> None:
        kept[message.header.stamp.sec * 10 + message.header.stamp.nanosec // 100_000_000] = message

    def show(self, image: Any, tenths: int, *, answered: bool = True) -> Any:
        """Show an image of a time, in tenths of a second, until its pose has come."""
        from sensor_msgs.msg import CameraInfo, Image
        from tracker_scene import Scene

        message, info = Image(), CameraInfo()
        for published in (message, info):
            published.header.stamp.sec, published.header.stamp.nanosec = tenths // 10, tenths % 10 * 100_000_000
            published.header.frame_id = "camera"
            published.height, published.width = image.shape[:2]
        message.encoding, message.step = "mono8", image.shape[1]
        message.data = image.tobytes()
        info.k, info.d, info.distortion_model = Scene.matrix(), [0.0] * 5, "plumb_bob"
        end = time.monotonic() + 30
        while tenths not in self.poses:
            assert time.monotonic() < end, f"no pose of the image of {tenths / 10} s within 30 s"
            self._infos.publish(info)
            self._images.publish(message)
            wait = time.monotonic() + 0.5
            while tenths not in self.poses and time.monotonic() < wait:
                self._turn(0.02)
        return self.poses[tenths]


def images(count: int) -> Iterator[tuple[int, Any, Any]]:
    """Images of a robot that drives straight, ten a second, with their times and where it really was."""
    from tracker_scene import Pose, Scene

    scene = Scene(Pose(-1.0, 0.2, 0.1), seed=8)
    try:
        scene.drive(SPEED, 0.0)
        scene.step(1.0)
        for index in range(count):
            yield BEGIN + index, cv2.cvtColor(scene.image(), cv2.COLOR_RGB2GRAY), scene.pose
            scene.drive(SPEED, 0.0)
            scene.step(0.1)
    finally:
        scene.close()


@pytest.mark.ros
@pytest.mark.usefixtures("rendering")
def test_images_become_poses_and_odometry(tracker: subprocess.Popen[str]):
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    context = Context()
    context.init(args=[])
    node = Node("camera", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        camera = Camera(node, lambda timeout: executor.spin_once(timeout_sec=timeout))
        last = 0
        for tenths, image, true in images(8):
            pose = camera.show(image, tenths)
            where = pose.pose.pose
            assert math.hypot(where.position.x - true.x, where.position.y - true.y) < 0.006
            assert 2 * math.atan2(where.orientation.z, where.orientation.w) == pytest.approx(true.heading, abs=0.06)
            assert 0 < pose.pose.covariance[0] < 0.01**2
            assert pose.header.frame_id == "map"
            last = tenths
        end = time.monotonic() + 20
        while last not in camera.odometry:
            assert time.monotonic() < end, "no odometry of the last image"
            executor.spin_once(timeout_sec=0.1)
        odometry = camera.odometry[last]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "robot")
        assert odometry.twist.twist.linear.x == pytest.approx(SPEED, abs=0.02)
        assert 0 < odometry.twist.covariance[0] < 0.02**2
        assert min(camera.odometry) >= BEGIN + 2, "no velocity before it was seen for long enough"
        tracker.send_signal(signal.SIGTERM)
        assert tracker.wait(20) == 0
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
