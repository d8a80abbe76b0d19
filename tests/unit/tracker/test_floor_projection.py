"""From corners to poses: exact where the corners are, as uncertain as they say where these aren't."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.tracker.configuration import CameraPose, Marker, Mounting, Reference
from understudy.tracker.floor_projection import Misfit, View, place, square, view_by, view_of
from understudy.tracker.image_messages import Calibration

MATRIX = np.array([[600.0, 0.0, 319.5], [0.0, 610.0, 239.5], [0.0, 0.0, 1.0]])
PLAIN = Calibration(MATRIX, np.zeros(5), False, 640, 480)
LENS = Calibration(MATRIX, np.array([-0.25, 0.08, 0.001, -0.002, 0.01]), False, 640, 480)
DOWN = CameraPose(x=0.3, y=-0.2, z=3.0, pitch=math.pi / 2, yaw=0.4)
TILTED = CameraPose(x=-2.0, y=0.5, z=2.0, roll=0.1, pitch=0.8, yaw=-0.2)
CAMERAS = st.sampled_from([(DOWN, PLAIN), (DOWN, LENS), (TILTED, PLAIN), (TILTED, LENS)])


def marker(**changes: Any) -> Marker:
    return Marker(**{"name": "robot", "id": 7, "size": 0.2, "height": 0.25, **changes})


def projected(points: Any, view: View, calibration: Calibration) -> Any:
    """Where a camera sees points of the world, in pixels."""
    turn = view.axes.T
    rotation, _ = cv2.Rodrigues(turn)
    pixels, _ = cv2.projectPoints(points, rotation, -turn @ view.place, calibration.matrix, calibration.distortion)
    return pixels.reshape(-1, 2)


def before(pose: CameraPose) -> tuple[float, float]:
    """Where the camera looks on the floor."""
    ahead = math.tan(math.pi / 2 - pose.pitch) * pose.z
    return pose.x + ahead * math.cos(pose.yaw), pose.y + ahead * math.sin(pose.yaw)


@settings(deadline=None)
@given(
    camera=CAMERAS,
    dx=st.floats(-0.6, 0.6),
    dy=st.floats(-0.6, 0.6),
    heading=st.floats(-math.pi, math.pi),
    mounted=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-math.pi, math.pi)),
)
def test_the_pose_of_the_robot_is_exact(camera, dx, dy, heading, mounted):
    pose, calibration = camera
    (x, y), view = before(pose), view_of(pose)
    x, y = x + dx, y + dy
    mx, my, turned = mounted
    c, s = math.cos(heading), math.sin(heading)
    corners = square(0.2, x + c * mx - s * my, y + s * mx + c * my, 0.25, heading + turned)
    robot = marker(mounted=Mounting(x=mx, y=my, yaw=turned))
    found = place(projected(corners, view, calibration), robot, calibration, view, 0.2)
    assert (found.x, found.y) == pytest.approx((x, y), abs=0.002)
    assert math.remainder(found.heading - heading, math.tau) == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-12)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


@pytest.mark.parametrize("camera", [DOWN, TILTED])
def test_the_reported_uncertainty_is_correct(camera: CameraPose):
    random, noise = np.random.default_rng(4), 0.3
    view, (x, y) = view_of(camera), before(camera)
    corners = projected(square(0.2, x, y, 0.25, 0.5), view, PLAIN)
    found = [place(corners + random.normal(0, noise, (4, 2)), marker(), PLAIN, view, noise) for _ in range(800)]
    spread = np.std([(one.x, one.y, one.heading) for one in found], axis=0)
    stated = np.sqrt(np.mean([np.diag(one.covariance) for one in found], axis=0))
    np.testing.assert_allclose(stated / spread, 1.0, atol=0.1)


def test_a_camera_that_looks_down_with_yaw_zero_shows_x_at_the_top():
    view = view_of(CameraPose(x=0, y=0, z=3, pitch=math.pi / 2))
    ((left, _), (right, _)) = projected(np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]), view, PLAIN)
    ((_, top),) = projected(np.array([[0.5, 0.0, 0.0]]), view, PLAIN)
    assert left < 319.5 < right
    assert top < 239.5


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"size": 0.3}, r"appears to be 0\.200 m wide, not 0\.3 m: its size or its height is wrong"),
        ({"height": 1.5}, "its size or its height is wrong"),
        ({"height": 3.5}, r"does not meet its plane: camera\.pose or the marker's height of 3\.5 m is wrong"),
    ],
)
def test_inconsistent_corners_are_refused_with_the_likely_cause(changes: dict[str, Any], expected: str):
    view = view_of(DOWN)
    corners = projected(square(0.2, 0.3, 0.1, 0.25, 0.5), view, PLAIN)
    with pytest.raises(Misfit, match=expected):
        place(corners, marker(**changes), PLAIN, view, 0.2)


def test_a_marker_seen_from_behind_is_ignored():
    view = view_of(DOWN)
    corners = projected(square(0.2, 0.3, 0.1, 0.25, 0.5), view, PLAIN)
    with pytest.raises(Misfit, match="from behind"):
        place(corners[::-1], marker(), PLAIN, view, 0.2)


REFERENCES = [
    Reference(id=20 + i, size=0.25, x=x, y=y, yaw=yaw)
    for i, (x, y, yaw) in enumerate([(-0.8, -0.6, 0.3), (0.9, 0.5, -2.0)])
]


@pytest.mark.parametrize("calibration", [PLAIN, LENS])
def test_markers_on_the_floor_give_the_pose_of_the_camera(calibration: Calibration):
    pose = CameraPose(x=0.1, y=-0.2, z=2.8, roll=0.05, pitch=1.4, yaw=0.7)
    view, random = view_of(pose), np.random.default_rng(5)
    looked = [
        (
            one,
            projected(square(one.size, one.x, one.y, one.z, one.yaw), view, calibration)
            + random.normal(0, 0.05, (4, 2)),
        )
        for one in REFERENCES
    ]
    found = view_by(looked, calibration)
    np.testing.assert_allclose(found.place, view.place, atol=0.01)
    np.testing.assert_allclose(found.axes, view.axes, atol=0.005)


def test_reference_markers_at_wrong_positions_are_refused():
    view = view_of(DOWN)
    looked = [(one, projected(square(one.size, one.x, one.y, one.z, one.yaw), view, PLAIN)) for one in REFERENCES]
    moved = [(looked[0][0].model_copy(update={"x": 0.4}), looked[0][1]), looked[1]]
    with pytest.raises(Misfit, match=r"one of them is not where camera\.references says"):
        view_by(moved, PLAIN)
