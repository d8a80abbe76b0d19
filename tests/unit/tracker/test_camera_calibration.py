"""A camera's calibration out of the file that camera_calibration writes, and what is said of one that can't be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.tracker.camera_calibration import load, read
from understudy.tracker.configuration import ConfigurationError
from understudy.tracker.process import main

WRITTEN = """\
image_width: 640
image_height: 480
camera_name: ceiling
camera_matrix:
  rows: 3
  cols: 3
  data: [512.5, 0, 321.25, 0, 511.75, 238.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.21, 0.05, 0.0011, -0.0024, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [480, 0, 320, 0, 0, 490, 239, 0, 0, 0, 1, 0]
"""


def changed(**changes: Any) -> str:
    return yaml.safe_dump({**yaml.safe_load(WRITTEN), **changes})


def test_a_measured_calibration_is_read():
    found = load(WRITTEN, "a.yaml")
    assert (found.width, found.height, found.fisheye) == (640, 480, False)
    np.testing.assert_array_equal(found.matrix, [[512.5, 0, 321.25], [0, 511.75, 238.5], [0, 0, 1]])
    np.testing.assert_array_equal(found.distortion, [-0.21, 0.05, 0.0011, -0.0024, 0])
    old = yaml.safe_load(WRITTEN)
    del old["distortion_model"]
    np.testing.assert_array_equal(load(yaml.safe_dump(old), "a.yaml").distortion, found.distortion)
    four = {"rows": 1, "cols": 4, "data": [0.01, 0.0, 0.0, 0.0]}
    assert load(changed(distortion_model="equidistant", distortion_coefficients=four), "a.yaml").fisheye


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "a.yaml: it has no camera_matrix; give a file that camera_calibration wrote"),
        ("{", "a.yaml is no YAML: "),
        (changed(image_width="wide"), "a.yaml: image_width: found 'wide'; give the number of pixels"),
        (changed(image_height=0), "a.yaml: image_height: found 0; give the number of pixels"),
        (changed(image_width=10**6, image_height=10**6), "a.yaml: 1000000 x 1000000 pixels are more than"),
        (changed(camera_matrix=[1, 0, 0]), "a.yaml: camera_matrix.data: found None; give a list of numbers"),
        (changed(camera_matrix={"data": [1, 2]}), "a.yaml: camera_matrix.data: found 2 numbers; it has 9"),
        (changed(camera_matrix={"data": [0] * 9}), "a.yaml: its matrix k is that of no camera"),
        (changed(distortion_coefficients={"data": ["a"]}), "a.yaml: distortion_coefficients.data: found ['a']; give"),
        (changed(distortion_coefficients={"data": [1, 2]}), "a.yaml: its d has 2 numbers; plumb_bob needs"),
        (changed(distortion_model="barrel"), "a.yaml: its distortion_model is 'barrel'; "),
        (changed(distortion_model=[1]), "a.yaml: distortion_model: found [1]; give a name such as plumb_bob"),
    ],
)
def test_a_mistake_is_reported_with_its_field(text: str, expected: str):
    with pytest.raises(ConfigurationError) as caught:
        load(text, "a.yaml")
    assert str(caught.value).startswith(expected)


@settings(max_examples=100, deadline=None)
@given(
    key=st.sampled_from(sorted(yaml.safe_load(WRITTEN))),
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.sampled_from(["data", "rows"]), inner),
        max_leaves=9,
    ),
)
def test_any_calibration_file_is_used_or_refused_with_a_message(key: str, value: object):
    text = changed(**{key: value})
    message = "a.yaml"
    try:
        found = load(text, "a.yaml")
    except ConfigurationError as error:
        message = str(error)
    else:
        assert found.matrix.shape == (3, 3)
    assert message.startswith("a.yaml")


def test_a_calibration_file_next_to_the_configuration_is_checked_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    file, beside = tmp_path / "tracker.yaml", tmp_path / "ceiling.yaml"
    file.write_text(
        "camera: {device: {path: /dev/video0, calibration: ceiling.yaml}, pose: {x: 0, y: 0, z: 3, pitch: 1.5708}}\n"
        "markers: [{name: robot, id: 7, size: 0.2, height: 0.25}]\n"
    )
    assert main([str(file), "--check"]) == 2
    assert capsys.readouterr().err.startswith(f"camera.device.calibration: {beside} cannot be read: ")
    beside.write_text(changed(image_width=0))
    assert main([str(file)]) == 2
    assert f"camera.device.calibration: {beside}: image_width: found 0; " in capsys.readouterr().err
    beside.write_text(WRITTEN)
    assert main([str(file), "--check"]) == 0
    assert read(beside).width == 640
