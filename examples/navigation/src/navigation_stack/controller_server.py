"""controller_server: drives along paths, by the action /follow_path."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import fields
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav2_msgs.action import FollowPath
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from navigation_stack import managed
from navigation_stack.conversions import pose_of
from navigation_stack.lasers import Laser
from navigation_stack.poses import Pose
from navigation_stack.pursuit import Command, Limits, Pursuit
from navigation_stack.serving import Goal, Outcome, Server
from navigation_stack.whereabouts import Whereabouts

_Result = FollowPath.Result

FEEDBACK = 0.25
"""s between two messages of feedback."""

HOLD = 2.0
"""s for which the robot is commanded to stand after a path: one command can be lost, and a short silence is not one of a goal."""

STALE = 1.0
"""s after which a scan or a pose is too old to drive by."""


class _Progress:
    """Whether the robot gets anywhere."""

    def __init__(self, radius: float, angle: float, allowance: float) -> None:
        self._radius, self._angle, self._allowance = radius, angle, allowance
        self._since: tuple[float, Pose] | None = None

    def made(self, pose: Pose) -> bool:
        now = time.monotonic()
        if self._since is None:
            self._since = now, pose
        before, there = self._since
        if (
            there.distance(pose) > self._radius
            or abs(math.remainder(pose.heading - there.heading, math.tau)) > self._angle
        ):
            self._since = now, pose
            return True
        return now - before < self._allowance


class ControllerServer(managed.Managed):
    """Publishes /cmd_vel while it follows a path, and for a while afterwards commands to stand.

    Parameters, named as Nav2's: controller_frequency, failure_tolerance, enable_stamped_cmd_vel,
    progress_checker.{required_movement_radius,movement_time_allowance}, and FollowPath.NAME for each of pursuit.Limits.
    FollowPath.desired_linear_vel can be changed while it drives.
    """

    def __init__(self) -> None:
        super().__init__("controller_server")
        self._turn = threading.Lock()
        standard = Limits()
        for field in fields(Limits):
            self.parameter(f"FollowPath.{field.name}", getattr(standard, field.name))
        self._pursuit = Pursuit(standard)
        self.add_on_set_parameters_callback(self._changed)

    def configured(self) -> None:
        self._pursuit = Pursuit(
            Limits(**{f.name: self.get_parameter(f"FollowPath.{f.name}").value for f in fields(Limits)})
        )
        frequency = self.parameter("controller_frequency", 20.0)
        if not 1 <= frequency <= 100:
            raise ValueError(f"controller_frequency: found {frequency}, it must be from 1 to 100 Hz")
        self._period = 1 / frequency
        self._patience = self.parameter("failure_tolerance", 2.0)
        self._frame = self.parameter("global_frame", "map")
        self._base = self.parameter("base_frame_id", "base_link")
        self._stamped = self.parameter("enable_stamped_cmd_vel", False)
        self._laser, self._whereabouts = Laser(self), Whereabouts(self)
        self._commands = self.create_lifecycle_publisher(TwistStamped if self._stamped else Twist, "/cmd_vel", 10)
        self.at_cleanup(lambda: self.destroy_lifecycle_publisher(self._commands))
        Server(self, FollowPath, "/follow_path", self._follow)

    def activated(self) -> None:
        self._hold_until = 0.0
        self._holding = managed.Loop(self._period, self._hold)

    def deactivated(self) -> None:
        self._holding.stop()
        with self._turn:  # the last word
            self._send(Command())

    def _changed(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "FollowPath.desired_linear_vel":
                if not (isinstance(parameter.value, float) and 0 < parameter.value <= 2):
                    return SetParametersResult(
                        successful=False, reason=f"{parameter.name}: found {parameter.value}, from 0 to 2 m/s is right"
                    )
                self._pursuit.limited(parameter.value)
        return SetParametersResult(successful=True)

    def _send(self, command: Command) -> None:
        if not self._stamped:
            plain = Twist()
            plain.linear.x, plain.angular.z = command.linear, command.angular
            self._commands.publish(plain)
            return
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = self._base
        message.twist.linear.x, message.twist.angular.z = command.linear, command.angular
        self._commands.publish(message)

    def _hold(self) -> None:
        if time.monotonic() < self._hold_until and self._turn.acquire(blocking=False):
            self._send(Command())
            self._turn.release()

    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds / 1e9)

    # -- a goal -----------------------------------------------------------------------------------------------------

    def _follow(self, goal: Goal) -> tuple[Outcome, Any]:
        result = _Result()
        # One path at a time: the one before sees within a period that it is superseded, and leaves the robot driving.
        with self._turn:
            if not goal.over:
                try:
                    self._pursuit.follow(self._path(goal.request.path))
                except ValueError as error:
                    result.error_code, result.error_msg = _Result.INVALID_PATH, str(error)
                else:
                    result.error_code, result.error_msg = self._drive(goal)
            if not goal.superseded:
                self._pursuit.forget()
                self._send(Command())
                self._hold_until = time.monotonic() + HOLD
        if goal.over:
            return "canceled" if goal.canceled else "aborted", result
        if result.error_code != _Result.NONE:
            self.get_logger().warning(f"path given up: {result.error_msg}")
        return "succeeded" if result.error_code == _Result.NONE else "aborted", result

    def _path(self, message: Any) -> list[Pose]:
        if message.header.frame_id != self._frame:
            raise ValueError(f"path: its frame is '{message.header.frame_id}', it must be {self._frame}")
        if not message.poses:
            raise ValueError("path: it has no poses")
        return [pose_of(stamped.pose) for stamped in message.poses]

    def _drive(self, goal: Goal) -> tuple[int, str]:
        """Drive until the goal is reached or over; an error code and text where it cannot be."""
        progress = _Progress(
            self.parameter("progress_checker.required_movement_radius", 0.3),
            self.parameter("progress_checker.required_movement_angle", 0.5),
            self.parameter("progress_checker.movement_time_allowance", 10.0),
        )
        going = following = time.monotonic()
        told = 0.0
        trouble: tuple[int, str] = (_Result.NONE, "")
        while not goal.over:
            now = time.monotonic()
            self._laser.take()
            self._whereabouts.take()
            pose, command = self._whereabouts.pose, Command(blocked=True)
            if pose is None or self._whereabouts.age(self._now()) > STALE:
                trouble = _Result.TF_ERROR, "it is not known where the robot is: no new /amcl_pose or /odom"
            elif abs(self._now() - self._laser.time) > STALE:
                trouble = _Result.NO_VALID_CONTROL, "the robot is blind: no new /scan"
            else:
                command = self._pursuit.command(pose, self._laser.points, self._period)
                trouble = _Result.PATIENCE_EXCEEDED, "something is in the way"
            self._send(command)
            if command.reached:
                return _Result.NONE, ""
            if not command.blocked:
                going = now
            elif now - going > self._patience:
                return trouble
            if pose is not None and not progress.made(pose):
                return _Result.FAILED_TO_MAKE_PROGRESS, "the robot gets nowhere"
            if now - told >= FEEDBACK:
                told = now
                goal.feedback(FollowPath.Feedback(distance_to_goal=self._pursuit.left, speed=command.linear))
            following = max(following + self._period, time.monotonic())
            time.sleep(max(0.0, following - time.monotonic()))
        return trouble


if __name__ == "__main__":
    managed.run(ControllerServer, threads=4)
