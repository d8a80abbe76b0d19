"""Which topics of a ROS graph look like commands to a robot, by their types and names."""

from __future__ import annotations

from collections.abc import Mapping

_TYPES = frozenset(
    {
        "ackermann_msgs/msg/AckermannDrive",
        "ackermann_msgs/msg/AckermannDriveStamped",
        "control_msgs/msg/JointJog",
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
        "trajectory_msgs/msg/JointTrajectory",
    }
)
"""Types of commands."""

_BARE = frozenset({"std_msgs/msg/Float32", "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"})
"""Types of commands if the name has one of the words below."""

_WORDS = ("cmd", "command")


def command_topics(types: Mapping[str, str]) -> list[str]:
    """Return the names of the topics that look like commands, of topics with their types by name. People must check them."""
    return sorted(name for name, type_name in types.items() if type_name in _TYPES or _is_named_so(name, type_name))


def _is_named_so(name: str, type_name: str) -> bool:
    return type_name in _BARE and any(word in name.rpartition("/")[2] for word in _WORDS)
