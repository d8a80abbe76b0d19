"""Reads a camera's calibration from a YAML file of ROS' camera_calibration and camera_calibration_parsers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from understudy.tracker.configuration import ConfigurationError, from_yaml
from understudy.tracker.image_messages import MOST_PIXELS, Calibration, Unusable, calibration

FIELD = "camera.device.calibration"
"""The field of the configuration that names the file."""

UNSAID = "plumb_bob"
"""The distortion model of a file that names none, which is usual in old files."""


def read(file: Path) -> Calibration:
    """Return the calibration in a file. Raises ConfigurationError with the name of the invalid field."""
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigurationError(
            f"{FIELD}: {file} cannot be read: {why}; give the file that camera_calibration wrote for this camera"
        ) from error
    return load(text, f"{FIELD}: {file}")


def load(text: str, source: str) -> Calibration:
    """Return the calibration in the text of a file. Raises ConfigurationError."""
    found = from_yaml(text, source, "a file that camera_calibration wrote")
    if not isinstance(found, Mapping):
        raise ConfigurationError(f"{source}: it has no camera_matrix; give a file that camera_calibration wrote")
    width, height = _pixels(found, "image_width", source), _pixels(found, "image_height", source)
    if width * height > MOST_PIXELS:
        raise ConfigurationError(f"{source}: {width} x {height} pixels are more than {MOST_PIXELS}")
    matrix = _numbers(found, "camera_matrix", source)
    if len(matrix) != 9:
        raise ConfigurationError(f"{source}: camera_matrix.data: found {len(matrix)} numbers; it has 9")
    model = found.get("distortion_model", UNSAID)
    if not isinstance(model, str):
        raise ConfigurationError(f"{source}: distortion_model: found {model!r}; give a name such as {UNSAID}")
    distortion = _numbers(found, "distortion_coefficients", source)
    try:
        return calibration(SimpleNamespace(width=width, height=height, k=matrix, d=distortion, distortion_model=model))
    except Unusable as error:
        raise ConfigurationError(f"{source}: {error} (k is camera_matrix, d is distortion_coefficients)") from error


def _pixels(found: Mapping[Any, Any], key: str, source: str) -> int:
    value = found.get(key)
    if type(value) is not int or value <= 0:
        raise ConfigurationError(f"{source}: {key}: found {value!r}; give the number of pixels that it was made with")
    return value


def _numbers(found: Mapping[Any, Any], key: str, source: str) -> list[float]:
    matrix = found.get(key)
    data = matrix.get("data") if isinstance(matrix, Mapping) else None
    if not isinstance(data, list) or any(type(value) not in (int, float) for value in data):
        raise ConfigurationError(f"{source}: {key}.data: found {data!r}; give a list of numbers")
    return [float(value) for value in data]
