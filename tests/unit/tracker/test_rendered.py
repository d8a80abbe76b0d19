"""The tracker and the leaf `motion` on rendered images: what is there is found, by real detection, in simulated time."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from tests.support.golden import assert_golden

pytestmark = pytest.mark.usefixtures("rendering")


@pytest.fixture(autouse=True)
def _one_thread():
    cv2.setNumThreads(1)


def test_poses_on_rendered_images_are_exact_to_millimetres():
    from bench.tracker import exactness

    errors, missed = exactness(40, seed=3)
    places, headings = np.array(errors).T
    assert missed <= 2
    assert np.sqrt(np.mean(places**2)) < 0.002
    assert places.max() < 0.006
    assert headings.max() < math.radians(3)


@pytest.mark.parametrize(("speed", "turn"), [(0.3, 0.0), (0.3, 0.4)])
def test_speeds_are_exact_to_millimetres_a_second(speed: float, turn: float):
    from bench.tracker import speeds

    found = np.array(speeds(2, speed, turn, seconds=4.5))
    assert len(found) > 15
    off = found[:, :2] - found[:, 2:]
    assert np.abs(found[:, 2].mean()) == pytest.approx(speed, abs=0.02), "it really drove"
    assert abs(off[:, 0].mean()) < 0.003
    assert off[:, 0].std() < 0.005
    assert off[:, 1].std() < 0.03


def test_the_reported_uncertainty_of_a_speed_is_not_too_small():
    from tracker_scene import Pose, Scene

    from bench.tracker import Supervised

    scene = Scene(Pose(-1.0, -0.4, 0.3), seed=4)
    supervised = Supervised(scene)
    wrong, stated, before = [], [], None
    try:
        while scene.time < 5.0:
            supervised.step((0.0, 0.0))
            pose = supervised.odometry
            if pose is not None and pose is not before:
                wrong.append(pose.twist.twist.linear.x)
                stated.append(pose.twist.covariance[0])
                before = pose
    finally:
        scene.close()
    assert len(wrong) > 30
    assert np.std(wrong) < 2 * math.sqrt(np.mean(stated))


@pytest.mark.parametrize("seed", range(3))
def test_a_commanded_robot_that_stands_is_detected_within_a_second(seed: int):
    from bench.tracker import stop

    late, verdict = stop(seed)
    assert late is not None
    assert 0 < late <= 1.0
    assert_golden(
        "tracker", "".join(verdict.reason.partition(": forward")[:2]), "/cmd_vel", "/tracker/robot/odometry", "forward"
    )
    assert verdict.leaf == "tracker/robot.motion"


def test_a_robot_that_drives_at_half_its_speed_is_detected():
    from bench.tracker import stop

    late, _ = stop(5, "half speed")
    assert late is not None
    assert late < 3.0


def test_ordinary_driving_causes_no_failure():
    """A minute of turns, stops, a little slip, and places out of the picture; `scripts/bench tracker` drives for ten."""
    from bench.tracker import ordinary

    found = ordinary(1.0, seed=8)
    assert found.alarms == []
    assert found.images == pytest.approx(600, abs=2)
    assert 100 < found.seen < 590, "it was in the picture, and also out of it"


def test_the_pose_of_the_camera_is_estimated_from_markers_on_the_floor():
    from tracker_scene import Pose, Scene
    from tracker_scene.scene import REFERENCE_SIZE, REFERENCES, CameraPlace

    from understudy.tracker.configuration import Configuration
    from understudy.tracker.image_messages import Calibration
    from understudy.tracker.robot_location import REFERENCE_IMAGES, Locator

    references = [
        {"id": n, "size": REFERENCE_SIZE, "x": x, "y": y, "yaw": yaw} for n, (x, y, yaw) in REFERENCES.items()
    ]
    place = CameraPlace(x=0.05, y=-0.1, z=3.1, roll=0.02, pitch=1.52, yaw=1.5)
    scene = Scene(Pose(0.4, 0.3, 1.0), camera=place, seed=6)
    locator = Locator(
        Configuration.model_validate(
            {
                "camera": {"image": "/camera/image_raw", "references": references},
                "markers": [{"name": "robot", "id": 7, "size": 0.2, "height": 0.2, "mounted": {"x": -0.03}}],
            }
        )
    )
    locator.calibrate(Calibration(np.array(Scene.matrix()).reshape(3, 3), np.zeros(5), False, 640, 480))
    try:
        hidden = np.full((480, 640), 128, np.uint8)
        assert locator.see(hidden, 0.0) == []
        assert_golden("tracker", locator.problems, "20, 21, 22, 23", "camera.references")
        found = []
        for tick in range(REFERENCE_IMAGES + 1):
            found = locator.see(cv2.cvtColor(scene.image(), cv2.COLOR_RGB2GRAY), 1.0 + tick / 10)
        assert locator.view is not None
        np.testing.assert_allclose(locator.view.place, (place.x, place.y, place.z), atol=0.03)
        (sighting,) = found
        true = scene.pose
        assert math.hypot(sighting.placed.x - true.x, sighting.placed.y - true.y) < 0.01
    finally:
        scene.close()
