"""The robot: follows the commands on /cmd_vel, and publishes /odom, /scan, its transforms and where it really is.

It writes down every command with its sender, and its motion ten times a second, so that what a failover meant for the
robot can be read from the robot itself. Which UDP port the reader of /cmd_vel listens on, or which QoS it has, comes
from the DDS profile that the environment names.
"""

from __future__ import annotations

import time

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry as OdometryMessage
from navigation_world import World
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from navigation_robot import STARTED, messages, running
from navigation_robot.base import Base
from navigation_robot.commands import Commands
from navigation_robot.journal import Journal
from navigation_robot.odometry import Odometry
from navigation_robot.simulation import Simulation

TICK = 0.02
"""Seconds between two looks at the clock: four steps of the physics."""

MEASURE = 2
"""Ticks in the period of odometry and its transform: 25 Hz."""

LOOK = 5
"""Ticks in the period of laser, ground truth and log: 10 Hz."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Robot:
    """A simulated robot in real time. Nothing of it waits for callbacks, so it needs no executor."""

    def __init__(self, world: World, journal: Journal) -> None:
        self._journal = journal
        # Without an executor nobody would answer the services that nodes have.
        self._node = Node("robot", start_parameter_services=False)
        self._simulation = Simulation(world)
        self._base = Base()
        self._measured = Odometry(np.random.default_rng([world.seed, 0]))
        self._commands = Commands(self._node)
        self._odometry = self._node.create_publisher(OdometryMessage, "/odom", 10)
        self._scan = self._node.create_publisher(LaserScan, "/scan", qos_profile_sensor_data)
        self._transforms = self._node.create_publisher(TFMessage, "/tf", 100)
        self._fixed = self._node.create_publisher(TFMessage, "/tf_static", LATCHED)
        self._truth = self._node.create_publisher(PoseStamped, "/ground_truth/pose", 10)
        self._fixed.publish(messages.laser_transform(self._now()))
        self._received = 0
        self._ticks = 0
        self._held = False
        self._touching = False
        start = self._simulation.pose
        journal.write(
            "started",
            time=time.time(),
            after=time.monotonic() - STARTED,
            seed=world.seed,
            x=start.x,
            y=start.y,
            heading=start.heading,
        )

    def run(self) -> None:
        """Drive until ROS is shut down."""
        running.tick(self._tick, TICK, self._journal)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()

    def _now(self) -> Time:
        return self._node.get_clock().now().to_msg()

    def _tick(self, now: float) -> None:
        for command in self._commands.take():
            self._received += 1
            self._base.command(command.linear, command.angular, now=now)
            pose = self._simulation.pose
            self._journal.write(
                "command",
                received=command.received,
                sequence=self._received,
                source=command.source,
                writer=command.writer,
                sent=command.sent,
                linear=command.linear,
                angular=command.angular,
                x=pose.x,
                y=pose.y,
                heading=pose.heading,
                speed=self._simulation.motion[0],
            )
        self._simulation.drive(*self._base.advance(now, TICK))
        self._simulation.step(round(TICK / self._simulation.timestep))
        self._ticks += 1
        self._watch(now)
        stamp = self._now()
        if self._ticks % MEASURE == 0:
            self._measured.update(*self._simulation.wheels, MEASURE * TICK)
            self._odometry.publish(messages.odometry(self._measured, stamp))
            self._transforms.publish(messages.transform(self._measured.pose, stamp))
        if self._ticks % LOOK == 0:
            self._scan.publish(messages.scan(self._simulation.scan(), stamp))
            self._truth.publish(messages.truth(self._simulation.pose, stamp))
            self._log()

    def _watch(self, now: float) -> None:
        held = self._base.held(now)
        if held != self._held:
            self._held = held
            self._journal.write("watchdog", time=time.time(), held=held)
        touching = self._simulation.touching
        if touching and not self._touching:
            pose = self._simulation.pose
            self._journal.write("bumped", time=time.time(), x=pose.x, y=pose.y)
        self._touching = touching

    def _log(self) -> None:
        pose, measured = self._simulation.pose, self._measured.pose
        speed, turn = self._simulation.motion
        self._journal.write(
            "odometry",
            time=time.time(),
            # Where it really is, as in the quickstart; beside it what its wheels say, in their own frame.
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            speed=speed,
            turn=turn,
            held=self._held,
            measured_x=measured.x,
            measured_y=measured.y,
            measured_heading=measured.heading,
        )
