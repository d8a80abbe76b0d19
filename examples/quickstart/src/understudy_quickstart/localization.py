"""Says where the robot is: the first of three nodes of which each depends on the one before (see examples/dependent).

What the robot measures is good enough here to be taken for the pose; a real localization would match the scan with the map.
"""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from understudy_quickstart.running import run


class Localization(Node):
    """Publishes /pose as often as /odom comes."""

    def __init__(self) -> None:
        super().__init__("localization")
        self._poses = self.create_publisher(PoseStamped, "/pose", 1)
        self.create_subscription(Odometry, "/odom", self._moved, 1)

    def _moved(self, message: Odometry) -> None:
        pose = PoseStamped()
        pose.header.stamp = message.header.stamp
        pose.header.frame_id = "map"
        pose.pose = message.pose.pose
        self._poses.publish(pose)


def main() -> None:
    """Run the node until it is asked to stop."""
    run(Localization)


if __name__ == "__main__":
    main()
