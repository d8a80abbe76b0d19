"""Computes the robot's pose on the floor from a marker's corners in the image.

The ray through the marker's centre is intersected with the plane in which the marker is known to move. A pose from the
corners alone (solvePnP) would derive the distance from the marker's size in the image, which is wrong by centimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from understudy.tracker.aruco_markers import Corners
from understudy.tracker.configuration import CameraPose, Marker, Reference
from understudy.tracker.image_messages import Calibration

Matrix = NDArray[np.float64]

MISFIT = 0.25
"""Relative error of a marker's apparent size, at its height, above which it is not the configured marker."""

_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from a camera's optical axes (z ahead, x to the right) to those of its body (x ahead, y to the left), REP
103."""

_STEP = 0.05
"""Step in pixels with which corners are moved to find the effect on a pose."""


class Misfit(ValueError):
    """What was found is not the configured marker, or is not where it should be. The text says why."""


@dataclass(frozen=True)
class View:
    """The place of a camera in the world: the directions of its optical axes, and its position in m."""

    axes: Matrix
    place: Matrix


def view_of(pose: CameraPose) -> View:
    """Return the view of a camera with a known pose."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (pose.roll, pose.pitch, pose.yaw))
    body = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return View(body @ _OPTICAL, np.array([pose.x, pose.y, pose.z]))


def square(size: float, x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Matrix:
    """Return the corners of a marker that lies flat, in the order of Corners.

    At a yaw of 0 its right edge is ahead (+x).
    """
    half = size / 2
    flat = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
    c, s = math.cos(yaw), math.sin(yaw)
    turned = flat @ np.array([[c, s], [-s, c]])
    return np.column_stack([turned + np.array([x, y]), np.full(4, z)])


def view_by(references: list[tuple[Reference, Corners]], calibration: Calibration) -> View:
    """Return the view of a camera that sees markers at known places on the floor. Raises Misfit."""
    world = np.concatenate([square(r.size, r.x, r.y, r.z, r.yaw) for r, _ in references])
    rays = calibration.rays(np.concatenate([corners for _, corners in references]))
    # Without distortion and with a focal length of 1, so that the same code handles every camera model.
    found, rotation, shift = cv2.solvePnP(world, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        raise Misfit("the reference markers give no pose of the camera")
    rotation, shift = cv2.solvePnPRefineLM(world, rays, np.eye(3), None, rotation, shift)
    turn = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    view = View(turn.T, (-turn.T @ np.asarray(shift, np.float64).reshape(3)))
    relative = (world - view.place) @ view.axes
    miss = float(np.abs(relative[:, :2] / relative[:, 2:] - rays).max() * calibration.matrix[0, 0])
    if miss > MOST_MISS or (relative[:, 2] <= 0).any():
        raise Misfit(
            f"the reference markers are seen {miss:.1f} pixels from where they should be: "
            "one of them is not where camera.references says, or the camera's calibration is wrong"
        )
    return view


MOST_MISS = 5.0
"""Maximum distance in pixels between a reference marker and where it should be seen."""


class FloorPose(NamedTuple):
    """The pose of a robot on the floor."""

    x: float
    y: float
    """m"""
    heading: float
    """rad"""
    covariance: Matrix
    """3 x 3, of x, y and heading."""


def place(corners: Corners, marker: Marker, calibration: Calibration, view: View, noise: float) -> FloorPose:
    """Return the pose of the robot whose marker is seen. ``noise`` is the standard deviation of a corner in pixels.

    Raises Misfit.
    """
    # Nine sets of corners at once: as they were found, and with each of their eight numbers moved a little.
    moved = np.repeat(corners[None], 9, axis=0)
    for index in range(8):
        moved[index + 1].flat[index] += _STEP
    rays = calibration.rays(moved.reshape(-1, 2))
    directions = np.column_stack([rays, np.ones(len(rays))]) @ view.axes.T
    down = marker.height - view.place[2]
    if not (directions[:, 2] * down > 0).all():
        raise Misfit(
            f"the line of sight to marker {marker.name} does not meet its plane: camera.pose or the marker's height of "
            f"{marker.height:g} m is wrong"
        )
    points = (view.place + directions * (down / directions[:, 2:]))[:, :2].reshape(9, 4, 2)
    poses = np.array([_pose(square_, marker) for square_ in points])
    edges = np.linalg.norm(points[0] - np.roll(points[0], -1, axis=0), axis=1)
    if abs(edges.mean() / marker.size - 1) > MISFIT or edges.max() > edges.min() * (1 + 2 * MISFIT):
        raise Misfit(
            f"the marker {marker.name} appears to be {edges.mean():.3f} m wide, not {marker.size:g} m: its size or its height is wrong, or "
            "another marker has its id"
        )
    if _cross(points[0][1] - points[0][0], points[0][3] - points[0][0]) > 0:
        raise Misfit(f"the marker {marker.name} is seen from behind")
    steps = poses[1:] - poses[0]
    steps[:, 2] = (steps[:, 2] + math.pi) % math.tau - math.pi
    jacobian = steps.T / _STEP
    x, y, heading = (float(value) for value in poses[0])
    return FloorPose(x, y, heading, jacobian @ jacobian.T * noise**2)


def _pose(points: Matrix, marker: Marker) -> tuple[float, float, float]:
    """Return x, y and heading of the robot from its marker's corners in their plane."""
    # The middle is where the diagonals cross.
    first, second = points[2] - points[0], points[3] - points[1]
    along = _cross(points[1] - points[0], second) / _cross(first, second)
    middle = points[0] + along * first
    ahead = points[1] - points[0] + points[2] - points[3]
    heading = math.atan2(ahead[1], ahead[0]) - marker.mounted.yaw
    c, s = math.cos(heading), math.sin(heading)
    x, y = marker.mounted.x, marker.mounted.y
    return float(middle[0] - c * x + s * y), float(middle[1] - s * x - c * y), math.remainder(heading, math.tau)


def _cross(a: Matrix, b: Matrix) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
