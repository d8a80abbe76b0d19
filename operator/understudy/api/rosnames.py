"""How topics, services, actions, nodes and their types are written."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from understudy.api.base import matching

ROS_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/(msg|srv|action)/[A-Z][a-zA-Z0-9]*$"
ROS_NAME_PATTERN = r"^/[a-zA-Z_][a-zA-Z0-9_]*(/[a-zA-Z_][a-zA-Z0-9_]*)*$"
ROS_NAME_MESSAGE = "write the full name, such as /cmd_vel: a slash, then letters, digits and underscores"
ROS_TYPE_MESSAGE = (
    "write the full ROS type, such as geometry_msgs/msg/Twist, std_srvs/srv/Trigger or nav2_msgs/action/NavigateToPose"
)

RosName = Annotated[
    str,
    Field(pattern=ROS_NAME_PATTERN, max_length=256, json_schema_extra=matching(ROS_NAME_PATTERN, ROS_NAME_MESSAGE)),
]
"""A fully qualified name of a topic, service, action or node."""
