"""A camera of this machine, read by OpenCV (V4L). No ROS is needed.

A thread waits for images and keeps the newest one. The tracker processes only that one, so it does not fall behind. The
thread empties the camera's own queue all the time, since images that wait in it are old.
"""

from __future__ import annotations

import errno
import math
import os
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from understudy.tracker.configuration import Device
from understudy.tracker.image_messages import Gray, Unusable

AGAIN = 1.0
"""Seconds after which the camera is looked for again if it has gone or does not exist yet."""

EARLY = 0.1
"""Fraction of the period between images that an image may be early."""

FASTEST = 240.0
"""Maximum rate of a video file in Hz. A file with a higher rate does not know its rate, and the configured one is
used."""

PATTERN = "%"
"""A path with this character is a numbered sequence of pictures, such as image%04d.png."""


class Frame(NamedTuple):
    """An image and the time at which it was taken."""

    stamp: int
    """When the image came out of the camera, in Unix nanoseconds."""
    image: Gray


class Footage:
    """Provides the newest image of a camera, and looks for the camera again if it has gone."""

    def __init__(self, device: Device, size: tuple[int, int]) -> None:
        """``size`` is the width and the height of the images that are requested from the camera, in pixels."""
        self._device, self._size = device, size
        self._newest: Frame | Unusable | None = None
        self._came = threading.Condition()
        self._ended = threading.Event()
        # A camera that hangs blocks this thread for up to ten seconds. The process does not have to wait for that.
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def take(self, timeout: float) -> Frame | None:
        """Return the newest image that was not returned yet, or wait for the next one.

        None if none arrives within ``timeout`` seconds. Raises Unusable with the reason, at each call, while the camera
        cannot be used.
        """
        with self._came:
            self._came.wait_for(lambda: self._newest is not None, timeout)
            newest, self._newest = self._newest, None
        if isinstance(newest, Unusable):
            raise newest
        return newest

    def close(self) -> None:
        """Close the camera."""
        self._ended.set()
        self._thread.join(AGAIN)

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                self._film()
            except Unusable as error:
                self._provide(error)
            except cv2.error as error:
                self._provide(Unusable(f"{self._device.path}: OpenCV cannot read it: {error}"))
            self._ended.wait(AGAIN)

    def _provide(self, newest: Frame | Unusable) -> None:
        with self._came:
            self._newest = newest
            self._came.notify()

    def _film(self) -> None:
        """Keep the newest image until there are no more. Raises Unusable."""
        period = (1 - EARLY) / self._device.rate
        with _opened(self._device, self._size) as (capture, pause):
            last = -math.inf
            while not self._ended.wait(pause):
                if not capture.grab():
                    raise Unusable(
                        f"{self._device.path} has ended, and is played again"
                        if pause
                        else f"{self._device.path} gives no more images: is it still connected?"
                    )
                stamp, now = time.time_ns(), time.monotonic()
                if now - last < period:
                    continue
                got, image = capture.retrieve()
                if not got:
                    raise Unusable(f"{self._device.path} gave an image that OpenCV cannot decode: try another format")
                last = now
                self._provide(Frame(stamp, _gray(np.asarray(image, np.uint8))))


@contextmanager
def _opened(device: Device, size: tuple[int, int]) -> Iterator[tuple[cv2.VideoCapture, float]]:
    """Provide the opened source, and the seconds to wait before each image (a camera has its own pace).

    Raises Unusable.
    """
    camera = _is_camera(device.path)
    capture = cv2.VideoCapture(device.path, cv2.CAP_V4L2 if camera else cv2.CAP_ANY)
    try:
        if not capture.isOpened():
            raise Unusable(
                f"camera.device.path: {device.path} delivers no images: another program uses it, or it is not the video capture device "
                f"(V4L2) of a camera, which may have several devices{_cameras()}"
                if camera
                else f"camera.device.path: {device.path} is neither a camera nor a video that OpenCV can read"
            )
        if not camera:
            rate = capture.get(cv2.CAP_PROP_FPS)
            yield capture, 1 / rate if 1 <= rate <= FASTEST else 1 / device.rate
            return
        # The image format decides which sizes a camera has, and the size which rates.
        if device.format is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*device.format))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        capture.set(cv2.CAP_PROP_FPS, device.rate)
        yield capture, 0.0
    finally:
        capture.release()


def _is_camera(path: str) -> bool:
    """Whether the path is a device. Raises Unusable with the reason if it cannot be opened."""
    if PATTERN in path:
        return False
    try:
        camera = stat.S_ISCHR(os.stat(path).st_mode)
        # OpenCV itself reports only that opening failed.
        os.close(os.open(path, (os.O_RDWR if camera else os.O_RDONLY) | os.O_NONBLOCK))
    except OSError as error:
        raise Unusable(refused(path, error)) from error
    return camera


def refused(path: str, error: OSError) -> str:
    """Return why a camera cannot be opened, and how to correct that."""
    problem = f"camera.device.path: {path} cannot be opened: {error.strerror}"
    match error.errno:
        case errno.ENOENT | errno.ENXIO | errno.ENODEV:
            return f"{problem}. Check that the camera is connected, and that a container has its device{_cameras()}"
        case errno.EACCES:
            return f"{problem}: user {os.getuid()} may not; add the group that the device belongs to (in a pod, supplementalGroups)"
        case errno.EPERM:
            return f"{problem}: this container may not use devices; have a device plugin give it to the pod, or make it privileged"
        case errno.EBUSY:
            return f"{problem}: another program has it"
    return problem


def _cameras() -> str:
    found = sorted(str(path) for path in Path("/dev").glob("video*"))
    return f"; there are {', '.join(found)}" if found else "; there is no /dev/video* here"


def _gray(image: Gray) -> Gray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
