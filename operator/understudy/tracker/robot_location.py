"""Finds poses and velocities of robots in images: all of the tracker except its ROS node."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from understudy.kinematics.velocities import Position, Velocities, Velocity
from understudy.tracker.aruco_markers import Corners, Detector
from understudy.tracker.configuration import Configuration, Marker
from understudy.tracker.floor_projection import FloorPose, Misfit, View, place, view_by, view_of
from understudy.tracker.image_messages import Calibration, Gray, Unusable

REFERENCE_IMAGES = 20
"""Number of images with all reference markers that are averaged, once: neither the markers nor the camera move."""


@dataclass(frozen=True)
class DetectedRobot:
    """A robot that was seen."""

    marker: Marker
    corners: Corners
    placed: FloorPose
    velocity: Velocity | None
    """None until the robot has been seen for long enough."""


class Locator:
    """Finds the robots of a configuration in images."""

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration
        self._markers = {marker.id: marker for marker in configuration.markers}
        self._velocities = {number: Velocities(configuration.window) for number in self._markers}
        self._detector = Detector(configuration.dictionary)
        self._calibration: Calibration | None = None
        self._references: list[list[Corners]] = []
        pose = configuration.camera.pose
        self.view: View | None = view_of(pose) if pose is not None else None
        """The place of the camera; None until the reference markers have shown it."""
        self.problems: list[str] = []
        """Problems of the last image."""

    def calibrate(self, calibration: Calibration) -> None:
        """Set the projection of the camera."""
        self._calibration = calibration

    def see(self, image: Gray, stamp: float) -> list[DetectedRobot]:
        """Return the robots in an image that was taken at ``stamp`` (seconds). Raises Unusable."""
        calibration = self._calibration
        if calibration is None:
            raise Unusable(f"nothing was received on {self._configuration.camera.calibration} yet")
        height, width = image.shape
        if calibration.width and (calibration.width, calibration.height) != (width, height):
            raise Unusable(
                f"it has {width} x {height} pixels, but {self._configuration.camera.calibration} is for "
                f"{calibration.width} x {calibration.height}"
            )
        self.problems = []
        try:
            found = self._detector.find(image)
        except cv2.error as error:
            raise Unusable(f"OpenCV cannot look for markers in it: {error}") from error
        if self.view is None:
            self._find_references(found, calibration)
        if self.view is None:
            return []
        sightings = []
        for number in sorted(found.keys() & self._markers.keys()):
            marker = self._markers[number]
            try:
                placed = place(found[number], marker, calibration, self.view, self._configuration.noise)
            except Misfit as error:
                self.problems.append(str(error))
                continue
            variances = tuple(float(placed.covariance[index, index]) for index in range(3))
            position = Position(stamp, placed.x, placed.y, placed.heading, (variances[0], variances[1], variances[2]))
            sightings.append(DetectedRobot(marker, found[number], placed, self._velocities[number].add(position)))
        return sightings

    def _find_references(self, found: dict[int, Corners], calibration: Calibration) -> None:
        references = self._configuration.camera.references
        if missing := [str(reference.id) for reference in references if reference.id not in found]:
            self.problems.append(f"the markers {', '.join(missing)} of camera.references are not seen yet")
            return
        self._references.append([found[reference.id] for reference in references])
        if len(self._references) < REFERENCE_IMAGES:
            return
        means = [np.asarray(np.mean(corners, axis=0), np.float64) for corners in zip(*self._references, strict=True)]
        self._references = []
        try:
            self.view = view_by(list(zip(references, means, strict=True)), calibration)
        except Misfit as error:
            self.problems.append(str(error))
