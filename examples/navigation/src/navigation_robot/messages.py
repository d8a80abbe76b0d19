"""What the robot tells, as ROS messages. Frames are those of REP 105: odom, base_link, and laser on it."""

from __future__ import annotations

import array
import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Quaternion, TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
from navigation_world import Pose
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from navigation_robot.model import LASER
from navigation_robot.odometry import Odometry
from navigation_robot.simulation import BEAMS, FARTHEST, NEAREST

SCAN_PERIOD = 0.1

# What a filter should believe of a pose and of a velocity: x, y and heading; the rest the robot does not have.
_POSE_COVARIANCE = np.diag((1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)).ravel()
_TWIST_COVARIANCE = np.diag((1e-4, 1e-6, 1e6, 1e6, 1e6, 1e-3)).ravel()


def _turned(heading: float) -> Quaternion:
    return Quaternion(z=math.sin(heading / 2), w=math.cos(heading / 2))


def odometry(of: Odometry, stamp: Time) -> OdometryMessage:
    """For /odom."""
    message = OdometryMessage()
    message.header.stamp = stamp
    message.header.frame_id = "odom"
    message.child_frame_id = "base_link"
    message.pose.pose.position.x = of.pose.x
    message.pose.pose.position.y = of.pose.y
    message.pose.pose.orientation = _turned(of.pose.heading)
    message.pose.covariance = _POSE_COVARIANCE
    message.twist.twist.linear.x = of.speed
    message.twist.twist.angular.z = of.turn
    message.twist.covariance = _TWIST_COVARIANCE
    return message


def scan(ranges: NDArray[np.float32], stamp: Time) -> LaserScan:
    """For /scan: all beams of one moment, counter-clockwise from behind."""
    message = LaserScan()
    message.header.stamp = stamp
    message.header.frame_id = "laser"
    message.angle_min = -math.pi
    message.angle_increment = math.tau / BEAMS
    message.angle_max = math.pi - math.tau / BEAMS
    message.scan_time = SCAN_PERIOD
    message.range_min = NEAREST
    message.range_max = FARTHEST
    # Of an array the message takes the bytes; it would look at every number of anything else.
    message.ranges = array.array("f", ranges.tobytes())
    return message


def transform(pose: Pose, stamp: Time) -> TFMessage:
    """For /tf: the base in the frame of its odometry."""
    one = TransformStamped()
    one.header.stamp = stamp
    one.header.frame_id = "odom"
    one.child_frame_id = "base_link"
    one.transform.translation.x = pose.x
    one.transform.translation.y = pose.y
    one.transform.rotation = _turned(pose.heading)
    return TFMessage(transforms=[one])


def laser_transform(stamp: Time) -> TFMessage:
    """For /tf_static: where the laser is on the base."""
    one = TransformStamped()
    one.header.stamp = stamp
    one.header.frame_id = "base_link"
    one.child_frame_id = "laser"
    one.transform.translation.x, one.transform.translation.y, one.transform.translation.z = LASER
    return TFMessage(transforms=[one])


def truth(pose: Pose, stamp: Time) -> PoseStamped:
    """For /ground_truth/pose, in the map's frame."""
    message = PoseStamped()
    message.header.stamp = stamp
    message.header.frame_id = "map"
    message.pose.position.x = pose.x
    message.pose.position.y = pose.y
    message.pose.orientation = _turned(pose.heading)
    return message
