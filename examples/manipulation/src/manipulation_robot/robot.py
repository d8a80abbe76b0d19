"""The robot: an arm that follows /arm_controller/joint_trajectory, and says where it is on /joint_states.

The commands are trajectories of one point each, which is taken when it comes: the arm is led by a stream of them and holds
where the last one left it. One without a point has it stay where it is, as with ROS's joint_trajectory_controller. What it
follows it says on /arm_controller/reference, so that whoever commands it can begin there.

It goes through whole trajectories too: see ``trajectories``.

It writes down every command with its sender and its step from the one before, and where its gripper is ten times a
second, so that what a failover meant for the robot can be read from the robot itself. Which UDP port the reader of the
commands listens on comes from the DDS profile that the environment names.
"""

from __future__ import annotations

import time

import numpy as np
from builtin_interfaces.msg import Time
from manipulation_arm import HOME, JOINTS, Joints
from navigation_robot import running
from navigation_robot.commands import Ear, Received
from navigation_robot.journal import Journal
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from manipulation_robot import STARTED
from manipulation_robot.controller import Controller
from manipulation_robot.simulation import Simulation
from manipulation_robot.trajectories import Trajectories, Trajectory

TICK = 0.01
"""Seconds between two looks at the clock: five steps of the physics. Twice as often as commands come."""

TELL = 2
"""Ticks in the period of joint states and reference: 50 Hz."""

LOG = 10
"""Ticks in the period of the log: 10 Hz."""


class Robot:
    """A simulated arm in real time. Nothing that moves it waits for callbacks, so it needs no executor."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        # Without an executor nobody would answer the services that nodes have.
        self._node = Node("arm_controller", start_parameter_services=False)
        self._simulation = Simulation()
        self._controller = Controller(HOME)
        self._commands = Ear(self._node, JointTrajectory, "/arm_controller/joint_trajectory")
        self._states = self._node.create_publisher(JointState, "/joint_states", 10)
        self._reference = self._node.create_publisher(JointState, "/arm_controller/reference", 10)
        self._trajectory: Trajectory | None = None
        self._trajectory_begun = 0.0
        self._trajectories = Trajectories(self._follow, lambda: self._controller.positions)
        self._received = 0
        self._ticks = 0
        self._held = False
        self._touching = False
        journal.write("started", time=time.time(), after=time.monotonic() - STARTED)

    def run(self) -> None:
        """Move until ROS is shut down."""
        running.tick(self._tick, TICK, self._journal)

    def close(self) -> None:
        """Leave the graph."""
        self._trajectories.close()
        self._node.destroy_node()

    def _tick(self, now: float) -> None:
        for command in self._commands.take():
            self._take(command, now)
        self._go_on(now)
        self._simulation.drive(self._controller.positions)
        self._simulation.step(round(TICK / self._simulation.timestep))
        self._ticks += 1
        self._watch(now)
        if self._ticks % TELL == 0:
            stamp = self._node.get_clock().now().to_msg()
            self._states.publish(_told(self._simulation.positions, self._simulation.velocities, stamp))
            self._reference.publish(_told(self._controller.positions, self._controller.velocities(now), stamp))
        if self._ticks % LOG == 0:
            self._log()

    def _take(self, command: Received, now: float) -> None:
        trajectory = command.message
        if list(trajectory.joint_names) != list(JOINTS) or len(trajectory.points) > 1:
            self._journal.write("refused", received=command.received, source=command.source)
            return
        self._end_trajectory()
        self._received += 1
        if trajectory.points:
            (point,) = trajectory.points
            step = self._controller.command(np.array(point.positions), np.array(point.velocities), now=now)
        else:
            step = self._controller.stay(now=now)
        self._journal.write(
            "command",
            received=command.received,
            sequence=self._received,
            source=command.source,
            writer=command.writer,
            sent=command.sent,
            step=step,
        )

    def _follow(self, trajectory: Trajectory) -> None:
        self._end_trajectory()
        self._trajectory_begun = time.monotonic()
        self._trajectory = trajectory
        self._journal.write("trajectory", time=time.time())

    def _go_on(self, now: float) -> None:
        trajectory = self._trajectory
        if trajectory is None:
            return
        if not trajectory.ended.is_set():
            positions = trajectory.at(now - self._trajectory_begun)
            self._controller.command(positions, (positions - self._controller.positions) / TICK, now=now)

    def _end_trajectory(self) -> None:
        if self._trajectory is not None:
            self._trajectory.end()

    def _watch(self, now: float) -> None:
        held = self._controller.held(now)
        if held != self._held:
            self._held = held
            self._journal.write("watchdog", time=time.time(), held=held)
        touching = self._simulation.touching
        if touching and not self._touching:
            x, y, z = self._simulation.gripper
            self._journal.write("bumped", time=time.time(), x=x, y=y, z=z)
        self._touching = touching

    def _log(self) -> None:
        x, y, z = self._simulation.gripper
        speed = float(np.abs(self._simulation.velocities).max())
        self._journal.write("arm", time=time.time(), x=x, y=y, z=z, speed=speed, held=self._held)


def _told(positions: Joints, velocities: Joints, stamp: Time) -> JointState:
    message = JointState(name=list(JOINTS), position=positions.tolist(), velocity=velocities.tolist())
    message.header.stamp = stamp
    return message
