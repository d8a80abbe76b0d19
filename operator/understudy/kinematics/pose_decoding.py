"""Reads the pose of a serialized message without ROS. Stamp, frames and pose are at the beginning of the message.

A monitor reads ten messages of a topic per second. Deserializing them would cost more than everything else that it does.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from understudy.kinematics.poses import Pose

ODOMETRY = "nav_msgs/msg/Odometry"

POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    ODOMETRY,
)
"""Types that begin with a header and a pose; in the last one, the body's frame is between them."""

_HEADER = 4
"""Bytes before the message itself. Alignment is counted from their end (CDR, OMG DDS-XTypes 7.4)."""


class Reading(NamedTuple):
    """The pose in a message, with its time and frames."""

    stamp: int
    """Time of the pose in ns, by the clock of its publisher; 0 if the message has none."""
    frame: str
    child: str
    """The body's own frame; empty if the type has none."""
    pose: Pose


def stamp_of(data: bytes) -> int:
    """Return the stamp in ns of a message whose type begins with a header; 0 if it has none. Raises ValueError."""
    order = _order(data)
    try:
        seconds, rest = struct.unpack_from(f"{order}iI", data, _HEADER)
    except struct.error as error:
        raise ValueError(f"{len(data)} bytes are not a message with a header") from error
    return int(seconds) * 1_000_000_000 + int(rest)


def read(type_name: str, data: bytes) -> Reading:
    """Read a message of one of POSE_TYPES, given as CDR with its header. Raises ValueError if it is invalid."""
    if type_name not in POSE_TYPES:
        raise ValueError(f"{type_name} has no pose at its beginning: {', '.join(POSE_TYPES)} do")
    order = _order(data)
    try:
        place = _HEADER + 8
        frame, place = _text(order, data, place)
        child = ""
        if type_name == ODOMETRY:
            child, place = _text(order, data, place)
        place += (_HEADER - place) % 8
        values = struct.unpack_from(f"{order}7d", data, place)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"its {len(data)} bytes are not a {type_name}: {error}") from error
    return Reading(stamp_of(data), frame, child, Pose.of(values))


def _order(data: bytes) -> str:
    """Return the byte order as the struct module writes it. Raises ValueError if the bytes are not plain CDR."""
    if len(data) < _HEADER or data[0] != 0 or data[1] > 1:
        raise ValueError(f"it is not plain CDR: it begins with {data[:_HEADER].hex() or 'nothing'}")
    return "<" if data[1] == 1 else ">"


def _text(order: str, data: bytes, place: int) -> tuple[str, int]:
    place += (_HEADER - place) % 4
    (length,) = struct.unpack_from(f"{order}I", data, place)
    end = place + 4 + length
    if not 1 <= length <= len(data) or end > len(data):
        raise struct.error(f"a text of {length} bytes")
    return data[place + 4 : end - 1].decode(), end
