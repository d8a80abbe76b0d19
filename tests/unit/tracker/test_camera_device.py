"""A camera that the tracker reads itself: what OpenCV really reads from files here; there is no camera on a machine for tests.

What is said of a camera that isn't there, or isn't one, is tried with V4L itself.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.support.golden import assert_golden
from tests.unit.dds import isolate_discovery
from understudy.tracker import camera_device
from understudy.tracker.camera_device import Footage, Frame, refused
from understudy.tracker.configuration import ConfigurationError, Device, load
from understudy.tracker.image_messages import Calibration, Unusable

REPOSITORY = Path(__file__).parents[3]
SIZE = (640, 480)
WITHIN = 20.0


def calibrated(size: tuple[int, int] = SIZE) -> str:
    from tracker_scene import Scene

    return (
        f"image_width: {size[0]}\nimage_height: {size[1]}\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {Scene.matrix(size)}}}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )


@pytest.fixture(scope="module")
def filmed(rendering: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    """A video of a robot that drives straight, ten images a second for three seconds, and where it was in each."""
    from tracker_scene import Pose, Scene

    file, poses = tmp_path_factory.mktemp("filmed") / "drive.avi", []
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE)
    scene = Scene(Pose(-1.0, 0.2, 0.1), seed=8)
    try:
        scene.drive(0.3, 0.0)
        scene.step(1.0)
        for _ in range(30):
            writer.write(cv2.cvtColor(scene.image(), cv2.COLOR_RGB2BGR))
            poses.append(scene.pose)
            scene.step(0.1)
    finally:
        scene.close()
        writer.release()
    return file, poses


@pytest.fixture
def footage(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Footage]]:
    """Makes one."""
    monkeypatch.setattr(camera_device, "AGAIN", 0.5)  # long enough for each trouble to be taken
    made: list[Footage] = []

    def make(path: Path | str, rate: float = 10.0) -> Footage:
        made.append(Footage(Device(path=str(path), calibration="unused", rate=rate), SIZE))
        return made[-1]

    yield make
    for one in made:
        one.close()


def next_of(found: Footage) -> Frame:
    """Its next image, whatever was wrong until then."""
    end = time.monotonic() + WITHIN
    while time.monotonic() < end:
        with contextlib.suppress(Unusable):
            if (frame := found.take(1.0)) is not None:
                return frame
    raise AssertionError(f"no image within {WITHIN:g} s")


def trouble_of(found: Footage) -> str:
    """What is wrong with it next."""
    end = time.monotonic() + WITHIN
    while time.monotonic() < end:
        try:
            found.take(1.0)
        except Unusable as error:
            return str(error)
    raise AssertionError(f"nothing was wrong within {WITHIN:g} s")


def test_a_rendered_video_becomes_poses(filmed: tuple[Path, list[Any]], footage: Callable[..., Footage]):
    from tracker_scene import Scene

    from bench.tracker import CONFIGURATION
    from understudy.tracker.robot_location import Locator

    file, poses = filmed
    locator = Locator(load(CONFIGURATION))
    locator.calibrate(Calibration(np.array(Scene.matrix()).reshape(3, 3), np.zeros(5), False, *SIZE))
    started_at, found, last = time.time_ns(), footage(file), 0
    places = []
    for _ in range(8):
        frame = next_of(found)
        assert started_at <= frame.stamp <= time.time_ns()
        assert frame.stamp > last
        last = frame.stamp
        places += [sighting.placed for sighting in locator.see(frame.image, frame.stamp / 1e9)]
    assert len(places) >= 6
    for place in places:
        assert min(math.hypot(place.x - pose.x, place.y - pose.y) for pose in poses) < 0.006
    assert [place.x for place in places] == sorted(place.x for place in places), "each is a later one"


def test_no_more_images_are_processed_than_requested(filmed: tuple[Path, list[Any]], footage: Callable[..., Footage]):
    found = footage(filmed[0], rate=4.0)
    stamps = [next_of(found).stamp for _ in range(4)]
    assert all(later - earlier > 0.2e9 for earlier, later in itertools.pairwise(stamps))


def test_a_numbered_sequence_of_pictures_is_read_as_a_video(tmp_path: Path, footage: Callable[..., Footage]):
    for index in range(5):
        cv2.imwrite(str(tmp_path / f"image{index:03d}.png"), np.full((48, 64, 3), 20 * index, np.uint8))
    found = footage(tmp_path / "image%03d.png", rate=50.0)
    assert next_of(found).image.shape == (48, 64)


def test_a_camera_that_disconnects_is_opened_again(
    filmed: tuple[Path, list[Any]], tmp_path: Path, footage: Callable[..., Footage]
):
    there = tmp_path / "video0"
    found = footage(there)
    missing = (
        f"camera.device.path: {there} cannot be opened: No such file or directory. Check that the camera is connected"
    )
    for _ in range(2):
        assert trouble_of(found).startswith(missing), "and so each time"
    os.link(filmed[0], there)
    assert next_of(found)
    there.unlink()  # what is open is read to its end
    assert trouble_of(found) == f"{there} has ended, and is played again"
    assert trouble_of(found).startswith(missing)
    os.link(filmed[0], there)
    assert next_of(found)


def test_opencv_is_built_with_v4l():
    assert cv2.CAP_V4L2 in cv2.videoio_registry.getCameraBackends()


def test_a_device_that_is_not_a_camera_is_reported(footage: Callable[..., Footage]):
    trouble = trouble_of(footage("/dev/null"))
    assert_golden("tracker", trouble.partition(" (")[0], "camera.device.path", "/dev/null")


def test_a_file_that_is_not_a_video_is_reported(tmp_path: Path, footage: Callable[..., Footage]):
    file = tmp_path / "notes.txt"
    file.write_text("no video")
    trouble = trouble_of(footage(file))
    assert_golden("tracker", trouble.replace(str(file), "FILE"), "camera.device.path", "FILE")


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.EACCES, "Permission denied: user .* may not; add the group that the device belongs to"),
        (errno.EPERM, "Operation not permitted: this container may not use devices; have a device plugin give it"),
        (errno.EBUSY, "Device or resource busy: another program has it"),
        (
            errno.ENXIO,
            "No such device or address. Check that the camera is connected, and that a container has its device",
        ),
        (errno.EIO, "Input/output error$"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_reported_with_a_solution(number: int, expected: str):
    trouble = refused("/dev/video0", OSError(number, os.strerror(number)))
    assert re.match(f"camera.device.path: /dev/video0 cannot be opened: {expected}", trouble)


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ("{}", "camera: set either 'image' (the topic of the images) or 'device' (a camera of this machine)"),
        ("{image: /i, device: {path: /dev/video0, calibration: c.yaml}}", "camera: set either"),
        ("{device: {path: /dev/video0}}", "camera.device.calibration: missing"),
        ("{device: {path: '', calibration: c.yaml}}", "camera.device.path: found ''; give a path, such as /dev/video0"),
        (
            "{device: {path: /dev/video0, calibration: c, rat: 5}}",
            "camera.device.rat: unknown field, did you mean 'rate'",
        ),
        ("{device: {path: /dev/video0, calibration: c, rate: 0}}", "camera.device.rate: found 0; "),
        ("{device: {path: /dev/video0, calibration: c, format: jpeg}}", "camera.device.format: found 'jpeg'; "),
        (
            "{device: {path: /dev/video0, calibration: c}, reliable: true}",
            "camera: 'info' and 'reliable' are for images on",
        ),
    ],
)
def test_a_mistake_about_the_camera_is_reported_with_its_field(camera: str, expected: str):
    with pytest.raises(ConfigurationError) as caught:
        load(f"camera: {camera}\nmarkers: [{{name: robot, id: 7, size: 0.2, height: 0.25}}]", "a.yaml")
    assert str(caught.value).startswith(f"a.yaml: {expected}")


@pytest.mark.ros
def test_the_tracker_reads_a_device_and_publishes_poses(
    filmed: tuple[Path, list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    isolate_discovery(monkeypatch)
    from nav_msgs.msg import Odometry

    from bench.tracker import CONFIGURATION
    from understudy.ros.runtime.graph_node import Graph

    file, poses = filmed
    (tmp_path / "ceiling.yaml").write_text(calibrated())
    configuration = tmp_path / "tracker.yaml"
    configuration.write_text(
        CONFIGURATION.replace("image: /camera/image_raw", f"device: {{path: {file}, calibration: ceiling.yaml}}")
    )
    graph = Graph("beside")
    subscription = graph.node.create_subscription(Odometry, "/tracker/robot/odometry", lambda _: None, 50)
    process = subprocess.Popen(
        [sys.executable, "-m", "understudy.main", "tracker", str(configuration)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY / "operator")},
    )
    try:
        found: list[Any] = []
        end = time.monotonic() + 30
        while len(found) < 5:
            assert time.monotonic() < end, f"{len(found)} of 5 within 30 s"
            with subscription.handle:
                taken = subscription.handle.take_message(Odometry, False)
            if taken is None:
                time.sleep(0.02)
                continue
            found.append(taken[0])
        for odometry in found:
            place, stamp = odometry.pose.pose.position, odometry.header.stamp
            assert min(math.hypot(place.x - pose.x, place.y - pose.y) for pose in poses) < 0.006
            assert abs(time.time() - stamp.sec) < 60
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.wait()
        graph.close()
