"""The laser, and where it is mounted."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from navigation_stack.conversions import scan_of, seconds, transform_of
from navigation_stack.managed import Input, Managed
from navigation_stack.poses import Pose

_FRAMES = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Deep enough for several publishers, who each latch one message."""


class Laser:
    """The newest scan."""

    def __init__(self, node: Managed) -> None:
        newest = QoSProfile(depth=1, reliability=qos_profile_sensor_data.reliability)
        self._scans: Input[LaserScan] = node.input(LaserScan, "/scan", newest)
        self._frames: Input[TFMessage] = node.input(TFMessage, "/tf_static", _FRAMES)
        self._base = node.parameter("base_frame_id", "base_link")
        self._mounts: dict[str, Pose] = {}
        self.scan: LaserScan | None = None

    def take(self) -> bool:
        """Take in what has come; whether there is a new scan of a laser whose place on the robot is known."""
        for message in self._frames.taken():
            for transform in message.transforms:
                if transform.header.frame_id == self._base:
                    self._mounts[transform.child_frame_id] = transform_of(transform)
        scans = self._scans.taken()
        if scans:
            self.scan = scans[-1]
        return bool(scans) and self.mount is not None

    @property
    def mount(self) -> Pose | None:
        """Where the laser is on the robot; None before that was said."""
        if self.scan is None:
            return None
        return (
            Pose(0.0, 0.0, 0.0)
            if self.scan.header.frame_id == self._base
            else self._mounts.get(self.scan.header.frame_id)
        )

    @property
    def stamp(self) -> Time:
        """Stamp of the newest scan; zero before the first."""
        return self.scan.header.stamp if self.scan else Time()

    @property
    def time(self) -> float:
        """Stamp of the newest scan, in s; 0 before the first."""
        return seconds(self.stamp)

    @property
    def points(self) -> NDArray[np.float32]:
        """What the newest scan saw, in the robot's frame, n by 2, in m."""
        mount = self.mount
        if self.scan is None or mount is None:
            return np.empty((0, 2), np.float32)
        ranges, bearings = scan_of(self.scan)
        seen = np.isfinite(ranges)
        bearings = bearings[seen] + np.float32(mount.heading)
        return np.column_stack(
            [mount.x + ranges[seen] * np.cos(bearings), mount.y + ranges[seen] * np.sin(bearings)]
        ).astype(np.float32)
