"""Patterns of ROS names and types. Does not import pydantic, because agents use it."""

from __future__ import annotations

ROS_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/(msg|srv|action)/[A-Z][a-zA-Z0-9]*$"
ROS_NAME_PATTERN = r"^/[a-zA-Z_][a-zA-Z0-9_]*(/[a-zA-Z_][a-zA-Z0-9_]*)*$"
LONGEST_ROS_NAME = 200
"""Most characters of a name. ROS allows 247, and an action, a node or a parameter service adds up to 30 to the name that is given."""

ROS_NAME_MESSAGE = (
    "write the full name, such as /cmd_vel or /controller_server: a slash, then letters, digits and underscores"
)
ROS_TYPE_MESSAGE = (
    "write the full ROS type, such as geometry_msgs/msg/Twist, std_srvs/srv/Trigger or nav2_msgs/action/NavigateToPose"
)
