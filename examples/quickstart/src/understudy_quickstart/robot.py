"""The robot: follows the commands on /cmd_vel, and publishes /odom, /scan and a latched /map.

It writes down every command with the pod that sent it, so that what a failover meant for the robot can be read from the
robot itself. Nothing in here knows of Understudy: which UDP port the reader of /cmd_vel listens on comes from the DDS
profile that the environment names.
"""

from __future__ import annotations

import math
import os
import time

import numpy as np
from geometry_msgs.msg import Quaternion, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from understudy_quickstart import STARTED
from understudy_quickstart.journal import Journal
from understudy_quickstart.kinematics import Base
from understudy_quickstart.running import run
from understudy_quickstart.world import ROBOT_RADIUS, START, quickstart_room

BEAMS = 180
REACH = 10.0
RANGE_NOISE = 0.01
MAP_RESOLUTION = 0.05
SCANNED_EVERY = 2
"""Steps from one scan, and one entry of the log, to the next."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Robot(Node):
    """A simulated differential drive robot with a laser scanner, in real time."""

    def __init__(self, journal: Journal) -> None:
        super().__init__("robot")
        self._journal = journal
        self._room = quickstart_room()
        self._base = Base(START, now=time.monotonic())
        self._bearings = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
        self._noise = np.random.default_rng()
        self._received = 0
        self._blocked = False
        self._held = False
        self._odometry = self.create_publisher(Odometry, "/odom", 10)
        self._scan = self.create_publisher(LaserScan, "/scan", qos_profile_sensor_data)
        self._map = self.create_publisher(OccupancyGrid, "/map", LATCHED)
        self._map.publish(self._occupancy())
        self.create_subscription(TwistStamped, "/cmd_vel", self._commanded, 10)
        self._steps = 0
        # One timer: each wake-up of rclpy's executor takes half a millisecond of a processor.
        self.create_timer(1 / 20, self._step)
        journal.write("started", time=time.time(), after=time.monotonic() - STARTED)

    def _commanded(self, message: TwistStamped, info: dict[str, int]) -> None:
        self._base.command(message.twist.linear.x, message.twist.angular.z, now=time.monotonic())
        self._received += 1
        pose = self._base.pose
        self._journal.write(
            "command",
            received=info["received_timestamp"] / 1e9,
            sequence=self._received,
            source=message.header.frame_id,
            sent=info["source_timestamp"] / 1e9,
            linear=message.twist.linear.x,
            angular=message.twist.angular.z,
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            speed=self._base.speed,
        )

    def _step(self) -> None:
        self._move()
        self._publish_odometry()
        self._steps += 1
        if self._steps % SCANNED_EVERY == 0:
            self._publish_scan()
            self._log_odometry()

    def _move(self) -> None:
        now = time.monotonic()
        pose = self._base.step(now)
        if self._room.fits(pose, ROBOT_RADIUS):
            self._base.place(pose)
            self._blocked = False
        else:
            self._base.bump()
            if not self._blocked:
                self._journal.write("bumped", time=time.time(), x=pose.x, y=pose.y)
            self._blocked = True
        held = self._base.held(now)
        if held != self._held:
            self._held = held
            self._journal.write("watchdog", time=time.time(), held=held)

    def _publish_odometry(self) -> None:
        message = Odometry()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "odom"
        message.child_frame_id = "base_link"
        pose = self._base.pose
        message.pose.pose.position.x = pose.x
        message.pose.pose.position.y = pose.y
        message.pose.pose.orientation = Quaternion(z=math.sin(pose.heading / 2), w=math.cos(pose.heading / 2))
        message.twist.twist.linear.x = self._base.speed
        message.twist.twist.angular.z = self._base.turn
        self._odometry.publish(message)

    def _publish_scan(self) -> None:
        ranges = self._room.ray_cast(self._base.pose, self._bearings, REACH)
        ranges += self._noise.normal(0.0, RANGE_NOISE, BEAMS)
        message = LaserScan()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.angle_min = float(self._bearings[0])
        message.angle_max = float(self._bearings[-1])
        message.angle_increment = math.tau / BEAMS
        message.scan_time = 0.1
        message.range_min = 0.05
        message.range_max = REACH
        message.ranges = ranges.astype(np.float32)
        self._scan.publish(message)

    def _occupancy(self) -> OccupancyGrid:
        cells = self._room.occupancy(MAP_RESOLUTION)
        message = OccupancyGrid()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "map"
        message.info.resolution = MAP_RESOLUTION
        message.info.height, message.info.width = cells.shape
        message.data = cells.ravel().tolist()
        return message

    def _log_odometry(self) -> None:
        pose = self._base.pose
        self._journal.write(
            "odometry",
            time=time.time(),
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            speed=self._base.speed,
            turn=self._base.turn,
            held=self._held,
        )


def main() -> None:
    """Run the robot until it is asked to stop. ``ROBOT_LOG`` names the journal's file."""
    journal = Journal(os.environ.get("ROBOT_LOG"))
    run(lambda: Robot(journal))


if __name__ == "__main__":
    main()
