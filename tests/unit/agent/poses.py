"""Poses as messages, for tests."""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import serialize_message

from understudy.api.protocol.kept_state import (
    KeptSample,
)

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def pose(x: float = 1.5, *, age: float = 10.0, **fields: Any) -> KeptSample:
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    message.header.stamp.sec = 42
    message.pose.pose.position.x = x
    message.pose.covariance[35] = 0.25
    usual = {"to": "/initialpose", "stamp": "now"}
    return KeptSample("/amcl_pose", POSE, time.time() - age, serialize_message(message), **usual | fields)
