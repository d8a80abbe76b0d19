"""Poses are read from what ROS serializes, and nothing else is taken for one."""

from __future__ import annotations

from typing import Any

import pytest

from understudy.kinematics.pose_decoding import POSE_TYPES, read, stamp_of

STAMP = 1_700_000_000_123_456_789


def message(type_name: str, frame: str = "odom", child: str = "base_link") -> Any:
    from understudy.ros.runtime.interface_types import message_class

    made = message_class(type_name)()
    made.header.frame_id = frame
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(STAMP, 1_000_000_000)
    if hasattr(made, "child_frame_id"):
        made.child_frame_id = child
    pose = made.pose.pose if hasattr(made.pose, "pose") else made.pose
    pose.position.x, pose.position.y, pose.position.z = 1.5, -2.5, 0.25
    pose.orientation.z, pose.orientation.w = 0.6, 0.8
    return made


@pytest.mark.ros
@pytest.mark.parametrize("type_name", POSE_TYPES)
@pytest.mark.parametrize("frame", ["", "o", "odom", "odom_", "robot_1/odometry/frame", "karte_ä"])
@pytest.mark.parametrize("child", ["", "base_link", "robot_1/base"])
def test_messages_that_ros_serialized_are_read(type_name: str, frame: str, child: str) -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    poses = read(type_name, serialization.serialize_message(message(type_name, frame, child)))
    assert (poses.stamp, poses.frame) == (STAMP, frame)
    assert poses.child == (child if type_name == "nav_msgs/msg/Odometry" else "")
    assert poses.pose == pytest.approx((1.5, -2.5, 0.25, 0.0, 0.0, 0.6, 0.8))


@pytest.mark.ros
@pytest.mark.parametrize("type_name", POSE_TYPES)
def test_truncated_messages_are_refused(type_name: str) -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    data = serialization.serialize_message(message(type_name))
    for length in range(0, 80):
        with pytest.raises(ValueError, match=r"no|isn't"):
            read(type_name, data[:length])


def test_the_other_byte_order_is_read_too() -> None:
    import struct

    head = struct.pack(">iI", 42, 7) + struct.pack(">I", 4) + b"map\0"
    data = b"\0\0\0\0" + head + struct.pack(">7d", 1, 2, 3, 0, 0, 0, 1)
    poses = read("geometry_msgs/msg/PoseStamped", data)
    assert (poses.stamp, poses.frame, poses.pose.place) == (42_000_000_007, "map", (1, 2, 3))
    assert stamp_of(data) == 42_000_000_007


@pytest.mark.parametrize("data", [b"", b"\0\1", b"\0\7\0\0" + bytes(200), b"\0\1\0\0" + bytes(4)])
def test_invalid_data_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"plain CDR|not a message|not a geometry"):
        read("geometry_msgs/msg/PoseStamped", data)


def test_a_type_without_a_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="sensor_msgs/msg/Imu has no pose at its beginning: geometry_msgs"):
        read("sensor_msgs/msg/Imu", b"\0\1\0\0")
