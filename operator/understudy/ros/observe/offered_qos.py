"""The QoS that publishers of a topic offer, in the form in which rosbag2 stores it with the topic.

`ros2 bag play` offers the same QoS again. Otherwise a topic that latches its last message would not match readers that
request that. Policies have their names of rosbag2 of Jazzy and later, which assume these names if a file does not give
the version of its metadata.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import yaml
from rclpy.duration import Duration
from rclpy.qos import QoSProfile

_SECOND = 1_000_000_000


def offers(profiles: Iterable[QoSProfile]) -> str:
    """Return profiles in the form of a recording, each different one once."""
    found: list[dict[str, Any]] = []
    for profile in profiles:
        values = _qos_values(profile)
        if values not in found:
            found.append(values)
    return str(yaml.safe_dump(found, sort_keys=False))


def _qos_values(profile: QoSProfile) -> dict[str, Any]:
    return {
        "history": profile.history.name.lower(),
        "depth": profile.depth,
        "reliability": profile.reliability.name.lower(),
        "durability": profile.durability.name.lower(),
        "deadline": _length(profile.deadline),
        "lifespan": _length(profile.lifespan),
        "liveliness": profile.liveliness.name.lower(),
        "liveliness_lease_duration": _length(profile.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def _length(duration: Duration) -> dict[str, int]:
    seconds, rest = divmod(duration.nanoseconds, _SECOND)
    return {"sec": seconds, "nsec": rest}
