"""Between ROS messages and the plain types of this package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose as PoseMessage
from geometry_msgs.msg import PoseStamped, Quaternion, TransformStamped
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan

from navigation_stack.grid import Grid
from navigation_stack.poses import Pose


def seconds(stamp: Time) -> float:
    """A stamp in s."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def heading(turn: Quaternion) -> float:
    """The heading of an orientation; NaN where it is none."""
    if not math.hypot(turn.x, turn.y, turn.z, turn.w) > 1e-6:
        return math.nan
    return math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))


def turned(angle: float) -> Quaternion:
    """The orientation of a heading."""
    return Quaternion(z=math.sin(angle / 2), w=math.cos(angle / 2))


def pose_of(message: PoseMessage) -> Pose:
    """A pose in the plane. Raises ValueError where a number is none, or the orientation is none."""
    pose = Pose(message.position.x, message.position.y, heading(message.orientation))
    if not all(map(math.isfinite, pose)):
        raise ValueError(f"a pose with finite numbers and an orientation is needed, found {message}")
    return pose


def message_of(pose: Pose) -> PoseMessage:
    """A pose as a message."""
    message = PoseMessage(orientation=turned(pose.heading))
    message.position.x, message.position.y = pose.x, pose.y
    return message


def transform_of(message: TransformStamped) -> Pose:
    """A transform, as the pose of the child's frame."""
    place = message.transform.translation
    return Pose(place.x, place.y, heading(message.transform.rotation))


def transform(pose: Pose, frame: str, child: str, stamp: Time) -> TransformStamped:
    """The pose of a child's frame as a message."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = frame, stamp
    message.transform.translation.x, message.transform.translation.y = pose.x, pose.y
    message.transform.rotation = turned(pose.heading)
    return message


def stamped(pose: Pose, frame: str, stamp: Time) -> PoseStamped:
    """A pose with its frame."""
    message = PoseStamped(pose=message_of(pose))
    message.header.frame_id, message.header.stamp = frame, stamp
    return message


def path_message(poses: Sequence[Pose], frame: str, stamp: Time) -> Path:
    """A path."""
    message = Path(poses=[stamped(pose, frame, stamp) for pose in poses])
    message.header.frame_id, message.header.stamp = frame, stamp
    return message


def grid_of(message: OccupancyGrid) -> Grid:
    """A map. Raises ValueError where it is empty."""
    info = message.info
    cells = np.asarray(message.data, dtype=np.int8).reshape(info.height, info.width)
    return Grid(cells, info.resolution, info.origin.position.x, info.origin.position.y)


def scan_of(message: LaserScan) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Ranges and bearings; a range that is no measurement is infinite."""
    ranges = np.array(message.ranges, dtype=np.float32)
    ranges[~((ranges >= message.range_min) & (ranges <= message.range_max))] = np.inf
    bearings = (message.angle_min + message.angle_increment * np.arange(len(ranges))).astype(np.float32)
    return ranges, bearings


def covariance_of(six: Any) -> list[list[float]]:
    """The covariance of x, y and heading out of that of a whole pose."""
    whole = np.asarray(six, dtype=float).reshape(6, 6)
    return whole[np.ix_([0, 1, 5], [0, 1, 5])].tolist()  # type: ignore[no-any-return]


def six_by_six(covariance: NDArray[np.float64]) -> list[float]:
    """The covariance of a whole pose out of that of x, y and heading."""
    whole = np.zeros((6, 6))
    whole[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    return whole.ravel().tolist()
