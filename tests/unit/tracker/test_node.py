"""The tracker's node reports images and calibrations that it cannot use, each problem once, and continues."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.dds import isolate_discovery
from understudy.tracker.configuration import load

pytestmark = pytest.mark.ros

CONFIGURATION = """
camera: {image: /camera/image_raw, pose: {x: 0, y: 0, z: 3, pitch: 1.5708}%s}
markers: [{name: robot, id: 7, size: 0.2, height: 0.2}]
"""


def made(more: str = "") -> Any:
    from understudy.tracker.tracker_node import Tracker

    return Tracker(load(CONFIGURATION % more))


@pytest.fixture
def tracker(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Iterator[Any]:
    isolate_discovery(monkeypatch)
    caplog.set_level(logging.WARNING)
    node = made()
    yield node
    node.close()


def image(encoding: str = "mono8", width: int = 64) -> Any:
    from sensor_msgs.msg import Image

    message = Image()
    message.header.stamp.sec = 5
    message.height, message.width, message.step, message.encoding = 48, width, width, encoding
    message.data = bytes(48 * width)
    return message


def info() -> Any:
    from sensor_msgs.msg import CameraInfo

    message = CameraInfo()
    message.height, message.width, message.distortion_model = 48, 64, "plumb_bob"
    message.k, message.d = [50.0, 0.0, 32.0, 0.0, 50.0, 24.0, 0.0, 0.0, 1.0], [0.0] * 5
    return message


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("understudy")]


def test_each_problem_is_reported_once_and_later_images_are_used(tracker: Any, caplog: pytest.LogCaptureFixture):
    for _ in range(3):
        tracker.on_image(image())
    assert_golden("tracker", messages(caplog), "/camera/image_raw", "/camera/camera_info")
    caplog.clear()
    broken = info()
    broken.k = [0.0] * 9
    tracker.on_calibration(broken)
    assert "the camera is not calibrated" in messages(caplog)[0]
    tracker.on_calibration(info())
    caplog.clear()
    tracker.on_image(image("16UC1"))
    tracker.on_image(image(width=32))
    assert_golden(
        "tracker", messages(caplog), "/camera/image_raw", "'16UC1'", "32 x 48", "/camera/camera_info", "64 x 48"
    )
    caplog.clear()
    tracker.on_image(image())
    assert messages(caplog) == []


def test_images_without_a_stamp_use_the_present_time(tracker: Any, caplog: pytest.LogCaptureFixture):
    tracker.on_calibration(info())
    message = image()
    message.header.stamp.sec = 0
    tracker.on_image(message)
    assert_golden("tracker", messages(caplog), "/camera/image_raw")


def test_calibrations_without_images_are_reported(tracker: Any, caplog: pytest.LogCaptureFixture):
    for _ in range(19):
        tracker.on_calibration(info())
    tracker.on_image(image())
    for _ in range(19):
        tracker.on_calibration(info())
    assert messages(caplog) == []
    tracker.on_calibration(info())
    assert_golden("tracker", messages(caplog), "/camera/camera_info", "/camera/image_raw", "camera.reliable")


def test_a_publisher_with_incompatible_qos_is_reported_with_its_name(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    isolate_discovery(monkeypatch)
    node = made(", reliable: true")
    try:
        for _ in range(20):
            node.on_calibration(info())
    finally:
        node.close()
    assert_golden("tracker", messages(caplog)[-1], "camera.reliable")
