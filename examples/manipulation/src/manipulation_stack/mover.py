"""move_group: brings the gripper to a pose, by the action /move_to_pose.

It finds joint positions for the pose and a way to them round what is in the way, and streams the joint commands on
/arm_controller/joint_trajectory at 50 Hz. Nothing of a motion is kept from goal to goal or from instance to instance:
each is planned from what the arm says that it follows, and planned again when the arm is found aside of the way. While it
is active it publishes /manipulation/heartbeat, so that its loss is noticed also when there is nothing to do.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
from manipulation_arm import JOINTS, Arm, Joints, Pose
from manipulation_interfaces.action import MoveToPose
from navigation_stack import managed
from navigation_stack.heartbeats import Heartbeat
from navigation_stack.serving import Goal, Outcome, Server, until
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from manipulation_stack.following import Follower
from manipulation_stack.motion import Command, Motion
from manipulation_stack.planning import NoWay, plan

_Result = MoveToPose.Result

FRAME = "base_link"

PERIOD = 0.02
"""s between two commands."""

LONGEST = 0.025
"""s that a command goes on at most, however late it is: on a busy machine the arm is slower, it does not take larger steps."""

FEEDBACK = 0.1
"""s between two messages of feedback."""

REPLAN = 0.25
"""s between two plans for an arm that another instance moves another way."""

RESTING = 0.5
"""s for which the reference must stay at the end of the way."""

KNOWN = 10.0
"""s to wait for the arm to say where it is."""


class _Failed(Exception):
    """A goal cannot be reached; a code and why."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


class Mover(managed.Managed):
    """The planner with its stream of commands."""

    def __init__(self) -> None:
        super().__init__("move_group")

    def configured(self) -> None:
        self._arm = Arm()
        self._planning = threading.Lock()
        self._reference: Command | None = None
        self._heard = self.input(JointState, "/arm_controller/reference", QoSProfile(depth=5))
        self._commands = self.create_lifecycle_publisher(JointTrajectory, "/arm_controller/joint_trajectory", 10)
        self.at_cleanup(lambda: self.destroy_lifecycle_publisher(self._commands))
        self._heartbeat = Heartbeat(self, "/manipulation/heartbeat")
        Server(self, MoveToPose, "/move_to_pose", self._move)

    def activated(self) -> None:
        self._heartbeat.begin()

    def deactivated(self) -> None:
        self._heartbeat.stop()

    # -- a goal -----------------------------------------------------------------------------------------------------

    def _move(self, goal: Goal) -> tuple[Outcome, Any]:
        # One at a time: the newer goal begins where the older one has left the arm.
        with self._planning:
            result = _Result()
            try:
                target = self._joints(goal)
                if target is not None:
                    self._follow(goal, target)
            except (_Failed, NoWay) as failure:
                result.error_code = failure.code if isinstance(failure, _Failed) else _Result.PLANNING_FAILED
                result.error_msg = str(failure)
                self.get_logger().error(f"given up: {failure}")
        if goal.over:
            return "canceled" if goal.canceled else "aborted", result
        if result.error_code == _Result.NONE:
            self.say("arrived")
        return "succeeded" if result.error_code == _Result.NONE else "aborted", result

    def _joints(self, goal: Goal) -> Joints | None:
        wanted = goal.request.pose
        if wanted.header.frame_id != FRAME:
            raise _Failed(_Result.INVALID_POSE, f"goal: its frame is '{wanted.header.frame_id}', it must be {FRAME}")
        place, turned = wanted.pose.position, wanted.pose.orientation
        pose = Pose(place.x, place.y, place.z, turned.w, turned.x, turned.y, turned.z)
        if not all(map(math.isfinite, pose)) or abs(math.hypot(*pose[3:]) - 1.0) > 0.01:
            raise _Failed(_Result.INVALID_POSE, "goal: its pose has no numbers, or an orientation that is none")
        self.say(f"to {pose.x:.2f}, {pose.y:.2f}, {pose.z:.2f}")
        target = self._arm.solve(pose, over=lambda: goal.over)
        if target is None and not goal.over:
            raise _Failed(_Result.NO_IK_SOLUTION, "goal: the arm does not reach it, or would touch something there")
        return target

    def _follow(self, goal: Goal, target: Joints) -> None:
        """Move there; returns when it has arrived, or the goal is over. Raises NoWay."""
        end = time.monotonic() + KNOWN
        while self._taken() is None:
            if until(threading.Event(), goal, PERIOD) or goal.over:
                return
            if time.monotonic() > end:
                raise _Failed(_Result.UNKNOWN, f"the arm has not said where it is for {KNOWN:g} s")
        journey = _Journey(self, goal, target)
        streaming = managed.Loop(PERIOD, journey.step)
        try:
            journey.watch()
        finally:
            streaming.stop()

    def way(self, start: Joints, target: Joints) -> Motion:
        """A motion to the target. Raises NoWay."""
        return Motion(plan(self._arm, start, target))

    def reference(self) -> Command:
        """What the arm follows."""
        taken = self._taken()
        assert taken is not None, "it has been heard before a journey begins"
        return taken

    def send(self, command: Command | None) -> None:
        """Send a command to the arm; None has it stay where it is."""
        trajectory = JointTrajectory(joint_names=list(JOINTS))
        if command is not None:
            point = JointTrajectoryPoint(positions=command.positions.tolist(), velocities=command.velocities.tolist())
            point.time_from_start.nanosec = int(PERIOD * 1e9)
            trajectory.points = [point]
        self._commands.publish(trajectory)

    def _taken(self) -> Command | None:
        for message in self._heard.taken()[-1:]:
            self._reference = Command(np.array(message.position), np.array(message.velocity))
        return self._reference


class _Journey:
    """One goal's motion: one thread streams its commands, another one watches and plans."""

    def __init__(self, mover: Mover, goal: Goal, target: Joints) -> None:
        self._mover, self._goal, self._target = mover, goal, target
        self._follower = Follower(mover.way(mover.reference().positions, target))
        self._last = time.monotonic()
        self._at_end: float | None = None
        self._arrived = threading.Event()

    def step(self) -> None:
        """Send the next command."""
        now = time.monotonic()
        reference = self._mover.reference()
        command = self._follower.step(reference, now, min(now - self._last, LONGEST))
        self._last = now
        self._mover.send(command)
        # The arm has arrived when it reports it, whoever commanded it: an instance that stands by arrives when the other one does.
        if float(np.abs(reference.positions - self._target).max()) > 1e-3:
            self._at_end = None
        elif self._at_end is None:
            self._at_end = now
        elif now - self._at_end > RESTING:
            self._arrived.set()

    def watch(self) -> None:
        """Until it has arrived, or the goal is over. Raises NoWay."""
        planned = told = time.monotonic()
        while not until(self._arrived, self._goal, PERIOD):
            if self._goal.over:
                return
            now = time.monotonic()
            if self._follower.strayed and now - planned >= REPLAN:
                planned = now
                self._follower.replace(self._mover.way(self._mover.reference().positions, self._target))
            if now - told >= FEEDBACK:
                told = now
                self._goal.feedback(MoveToPose.Feedback(distance_remaining=self._follower.remaining))


def started() -> Mover:
    """A planner that is active. It needs nobody to bring it up: all that it must know the arm says."""
    mover = Mover()
    mover.trigger_configure()
    mover.trigger_activate()
    return mover
