"""Images and calibrations as ROS says them."""

from __future__ import annotations

from array import array
from typing import Any

import cv2
import numpy as np
import pytest

from tests.support.ros_messages import CameraInfo, Image
from understudy.tracker.image_messages import Unusable, calibration, gray

RANDOM = np.random.default_rng(2)
PICTURE = RANDOM.integers(0, 256, (6, 5, 3), np.uint8)
"""RGB."""


def message(pixels: Any, encoding: str, padding: int = 0, cut: int = 0) -> Any:
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    step = rows.shape[1] + padding
    data = np.full((height, step), 255, np.uint8)
    data[:, : rows.shape[1]] = rows
    raw = data.tobytes()
    return Image(height=height, width=width, encoding=encoding, step=step, data=array("B", raw[: len(raw) - cut]))


def encoded(encoding: str) -> Any:
    conversions = {
        "rgb8": PICTURE,
        "bgr8": PICTURE[:, :, ::-1],
        "rgba8": np.dstack([PICTURE, np.full((6, 5), 9, np.uint8)]),
        "bgra8": np.dstack([PICTURE[:, :, ::-1], np.full((6, 5), 9, np.uint8)]),
        "mono8": cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY),
    }
    return conversions[encoding]


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8", "rgba8", "bgra8"])
@pytest.mark.parametrize("padding", [0, 3])
def test_every_encoding_gives_the_same_shades_whatever_the_rows_are_padded_with(encoding: str, padding: int):
    expected = cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY)
    # The last row may lack its padding.
    found = gray(message(encoded(encoding), encoding, padding, cut=padding))
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"encoding": "16UC1"}, "its encoding is '16UC1'; mono8, rgb8, bgr8, rgba8, bgra8 can be read"),
        ({"step": 14}, "its step of 14 bytes is too small for 5 pixels in rgb8"),
        ({"height": 7}, "it has 90 bytes, but its size requires 105"),
        ({"height": 0}, "it has 5 x 0 pixels"),
        ({"width": 1 << 31, "step": 1 << 33}, "pixels"),
    ],
)
def test_an_unusable_image_is_refused_with_the_reason(changes: dict[str, Any], expected: str):
    broken = message(PICTURE, "rgb8")
    broken.__dict__.update(changes)
    with pytest.raises(Unusable, match=expected):
        gray(broken)


def info(**changes: Any) -> Any:
    parameters = {
        "width": 640,
        "height": 480,
        "k": [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0],
        "d": [-0.2, 0.05, 0.001, -0.002, 0.0],
        "distortion_model": "plumb_bob",
    }
    return CameraInfo(**{**parameters, **changes})


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", [-0.2, 0.05, 0.001, -0.002, 0.01]),
        ("rational_polynomial", [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003]),
        ("", []),
    ],
)
def test_rays_invert_the_distortion_of_the_lens(model: str, d: list[float]):
    found = calibration(info(distortion_model=model, d=d))
    points = RANDOM.uniform(-0.4, 0.4, (20, 2))
    matrix = np.array(info().k).reshape(3, 3)
    pixels, _ = cv2.projectPoints(
        np.column_stack([points, np.ones(20)]), np.zeros(3), np.zeros(3), matrix, np.array(d) if d else None
    )
    np.testing.assert_allclose(found.rays(pixels.reshape(-1, 2)), points, atol=2e-4)


def test_the_distortion_of_a_fisheye_is_inverted_too():
    d = [0.02, -0.01, 0.003, -0.001]
    found = calibration(info(distortion_model="equidistant", d=d))
    points = RANDOM.uniform(-0.8, 0.8, (20, 2))
    matrix = np.array(info().k).reshape(3, 3)
    pixels = cv2.fisheye.distortPoints(points.reshape(-1, 1, 2), matrix, np.array(d))
    np.testing.assert_allclose(found.rays(pixels.reshape(-1, 2)), points, atol=2e-4)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"k": [0.0] * 9}, "its matrix k is that of no camera: the camera is not calibrated"),
        ({"distortion_model": "barrel"}, "its distortion_model is 'barrel'; plumb_bob, .*can be used"),
        ({"d": [0.1, 0.2]}, "its d has 2 numbers; plumb_bob needs 0 or 4 or 5"),
        ({"d": [float("nan")] * 5}, "finite"),
    ],
)
def test_an_unusable_calibration_is_refused_with_the_reason(changes: dict[str, Any], expected: str):
    with pytest.raises(Unusable, match=expected):
        calibration(info(**changes))
