"""Converts ROS images and calibrations to arrays.

No ROS is needed: any object with the fields of the message is accepted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
}
"""Bytes per pixel, and the conversion to gray (names as in sensor_msgs/image_encodings.hpp)."""

MOST_PIXELS = 64_000_000


class Unusable(ValueError):
    """An image or a calibration that cannot be used. The text says why."""


def gray(message: Any) -> Gray:
    """Return a sensor_msgs/Image in shades of gray. Raises Unusable."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    if message.encoding not in ENCODINGS:
        raise Unusable(f"its encoding is {message.encoding!r}; {', '.join(ENCODINGS)} can be read")
    depth, conversion = ENCODINGS[message.encoding]
    if not 0 < width * height <= MOST_PIXELS:
        raise Unusable(f"it has {width} x {height} pixels")
    if step < width * depth:
        raise Unusable(f"its step of {step} bytes is too small for {width} pixels in {message.encoding}")
    data: NDArray[np.uint8] = np.frombuffer(message.data, np.uint8)
    # The last row may lack its padding.
    if data.size < step * (height - 1) + width * depth:
        raise Unusable(f"it has {data.size} bytes, but its size requires {step * height}")
    shape, strides = (height, width, depth), (step, depth, 1)
    pixels = np.lib.stride_tricks.as_strided(data, shape, strides, writeable=False)
    if conversion is None:
        return np.ascontiguousarray(pixels[:, :, 0])
    return cv2.cvtColor(np.ascontiguousarray(pixels), conversion).astype(np.uint8, copy=False)


class Calibration(NamedTuple):
    """The projection of a camera (sensor_msgs/CameraInfo)."""

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    fisheye: bool
    width: int
    height: int

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where rays through pixels (n x 2) meet the plane one metre in front of the camera.

        The result is without distortion.
        """
        points = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        if self.fisheye:
            found = cv2.fisheye.undistortPoints(points, self.matrix, self.distortion)
        else:
            found = cv2.undistortPoints(points, self.matrix, self.distortion)
        return np.asarray(found, np.float64).reshape(-1, 2)


MODELS = {
    "": (0, 4, 5),
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
    "fisheye": (4,),
}
"""Distortion models (sensor_msgs/distortion_models.hpp), and how many coefficients they may have."""


def calibration(message: Any) -> Calibration:
    """Return the calibration of a sensor_msgs/CameraInfo, for images that are not rectified. Raises Unusable."""
    matrix = np.array(message.k, np.float64).reshape(3, 3)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[2, 2] != 1:
        raise Unusable("its matrix k is that of no camera: the camera is not calibrated")
    model, distortion = message.distortion_model, np.array(message.d, np.float64)
    if model not in MODELS:
        raise Unusable(f"its distortion_model is {model!r}; {', '.join(filter(None, MODELS))} can be used")
    if distortion.size not in MODELS[model] or not np.isfinite(distortion).all():
        counts = " or ".join(str(count) for count in MODELS[model])
        raise Unusable(f"its d has {distortion.size} numbers; {model or 'no model'} needs {counts}, all of them finite")
    return Calibration(matrix, distortion, model in ("equidistant", "fisheye"), int(message.width), int(message.height))
