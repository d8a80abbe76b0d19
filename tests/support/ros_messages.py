"""Messages of common ROS types for tests without ROS: the fields that the code under test reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class Stamp:
    """builtin_interfaces/msg/Time."""

    sec: int = 0
    nanosec: int = 0


@dataclass
class Header:
    """std_msgs/msg/Header."""

    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = ""


@dataclass
class Vector3:
    """geometry_msgs/msg/Vector3."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Twist:
    """geometry_msgs/msg/Twist."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped:
    """geometry_msgs/msg/TwistStamped."""

    twist: Twist


@dataclass
class TwistWithCovariance:
    """geometry_msgs/msg/TwistWithCovariance."""

    twist: Twist
    covariance: list[float]


@dataclass
class Odometry:
    """nav_msgs/msg/Odometry, without its pose."""

    twist: TwistWithCovariance


@dataclass
class TransformStamped:
    """geometry_msgs/msg/TransformStamped, without its transform."""

    header: Header
    child_frame_id: str


@dataclass
class TFMessage:
    """tf2_msgs/msg/TFMessage."""

    transforms: list[TransformStamped]


@dataclass
class Image:
    """sensor_msgs/msg/Image, without its header."""

    height: int
    width: int
    encoding: str
    step: int
    data: Sequence[int]


@dataclass
class CameraInfo:
    """sensor_msgs/msg/CameraInfo."""

    width: int
    height: int
    k: Sequence[float]
    d: Sequence[float]
    distortion_model: str
