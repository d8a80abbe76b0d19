"""The application: drives the robot round its waypoints, by /odom and /scan, once it has the map.

An ordinary ROS 2 node. It knows nothing of Understudy, of the gate or of whether it is the one in control: a standby
runs the same code and computes the same commands, and the network drops them. The sender's name travels in the
command's frame, which the base has no other use for, so that the robot's log can tell the instances apart.
"""

from __future__ import annotations

import math
import os
import socket
import time

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from understudy_quickstart import STARTED
from understudy_quickstart.kinematics import Pose
from understudy_quickstart.pursuit import WAYPOINTS, Circuit, Pursuit, space_ahead
from understudy_quickstart.running import run

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Driving:
    """Follows the circuit from a node, at 20 commands a second or as many as DRIVE_HERTZ says."""

    def __init__(self, node: Node, name: str) -> None:
        self._node, self._name = node, name
        self._pursuit = Pursuit(Circuit(WAYPOINTS))
        self._pose: Pose | None = None
        self._ahead: float | None = None
        self._mapped = False
        self._next: int | None = None
        self._commands = Node.create_publisher(node, TwistStamped, "/cmd_vel", 10)
        self._inputs = [
            node.create_subscription(Odometry, "/odom", self._moved, 1),
            node.create_subscription(LaserScan, "/scan", self._scanned, qos_profile_sensor_data),
            node.create_subscription(OccupancyGrid, "/map", self._charted, LATCHED),
        ]
        self._timer = node.create_timer(1 / float(os.environ.get("DRIVE_HERTZ") or 20), self._drive, autostart=False)
        self._say(f"{name} is up after {_age():.2f} s")

    def start(self) -> None:
        """Drive from now on."""
        self._timer.reset()

    def stop(self) -> None:
        """Drive no more; everything is received as before."""
        self._timer.cancel()

    def end(self) -> None:
        """Let go of everything."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._commands)
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)

    def _say(self, text: str) -> None:
        self._node.get_logger().info(text)

    def _moved(self, message: Odometry) -> None:
        turn = message.pose.pose.orientation
        position = message.pose.pose.position
        if self._pose is None:
            self._say(f"odometry received after {_age():.2f} s")
        self._pose = Pose(position.x, position.y, 2 * math.atan2(turn.z, turn.w))

    def _scanned(self, message: LaserScan) -> None:
        if self._ahead is None:
            self._say(f"scan received after {_age():.2f} s")
        self._ahead = space_ahead(message.ranges, message.angle_min, message.angle_increment)

    def _charted(self, message: OccupancyGrid) -> None:
        self._say(f"map received after {_age():.2f} s")
        grid = np.asarray(message.data).reshape(message.info.height, message.info.width)
        for number, (x, y) in enumerate(WAYPOINTS):
            column, row = int(x / message.info.resolution), int(y / message.info.resolution)
            if not (0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]) or grid[row, column] != 0:
                self._node.get_logger().error(f"waypoint {number} at {x}, {y} is not free in the map: not driving")
                return
        self._mapped = True

    def _drive(self) -> None:
        if self._pose is None or self._ahead is None or not self._mapped:
            return
        number = self._pursuit.circuit.waypoint_after(self._pursuit.circuit.nearest(self._pose.x, self._pose.y))
        if number != self._next:
            self._say(f"to waypoint {number}, from {self._pose.x:.2f}, {self._pose.y:.2f}")
            self._next = number
        linear, angular = self._pursuit.command(self._pose, self._ahead)
        message = TwistStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = self._name
        message.twist.linear.x = linear
        message.twist.angular.z = angular
        self._commands.publish(message)


class Drive(Node):
    """Drives by itself, as soon as it can."""

    def __init__(self, name: str) -> None:
        super().__init__("drive")
        self._driving = Driving(self, name)
        self._driving.start()


class ManagedDrive(LifecycleNode):
    """The same as a managed node: configured it receives everything, active it drives."""

    def __init__(self, name: str) -> None:
        super().__init__("drive")
        self._name = name
        self._driving: Driving | None = None

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Receive odometry, scans and the map."""
        self._driving = Driving(self, self._name)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drive."""
        assert self._driving is not None, "it was configured"
        self._driving.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stand still."""
        assert self._driving is not None, "it was configured"
        self._driving.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything."""
        assert self._driving is not None, "it was configured"
        self._driving.end()
        self._driving = None
        return super().on_cleanup(state)


def _age() -> float:
    return time.monotonic() - STARTED


def main() -> None:
    """Run the application until it is asked to stop; with DRIVE_MANAGED it waits to be configured and activated."""
    kind = ManagedDrive if os.environ.get("DRIVE_MANAGED") else Drive
    run(lambda: kind(os.environ.get("HOSTNAME") or socket.gethostname()))


if __name__ == "__main__":
    main()
