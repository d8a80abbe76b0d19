"""Regulated pure pursuit: the turn follows a point ahead on the path, the speed what lies around.

Macenski, Singh, Martín, Ginés: Regulated Pure Pursuit for Robot Path Tracking (2023); names of parameters as in Nav2's
controller of that name. Plain numbers instead of arrays where there are few: they are faster then.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from navigation_stack.poses import Pose, wrapped


@dataclass(frozen=True, slots=True)
class Limits:
    """How it is driven, in m, rad and s."""

    desired_linear_vel: float = 0.45
    lookahead_time: float = 0.9
    min_lookahead_dist: float = 0.25
    max_lookahead_dist: float = 0.5
    rotate_to_heading_min_angle: float = 0.785
    rotate_to_heading_angular_vel: float = 1.2
    max_angular_accel: float = 3.2
    max_linear_accel: float = 1.0
    regulated_linear_scaling_min_radius: float = 0.6
    regulated_linear_scaling_min_speed: float = 0.12
    approach_velocity_scaling_dist: float = 0.5
    min_approach_linear_velocity: float = 0.06
    max_allowed_time_to_collision: float = 1.0
    robot_radius: float = 0.18
    collision_margin: float = 0.02
    """Free space around the robot that is kept, in m."""
    slow_within: float = 0.2
    """Nearer than this to something that is ahead, in m beyond the radius, it is driven more slowly."""
    xy_goal_tolerance: float = 0.1
    yaw_goal_tolerance: float = 0.15


@dataclass(frozen=True, slots=True)
class Command:
    """The command to the base."""

    linear: float = 0.0
    angular: float = 0.0
    reached: bool = False
    """The goal is reached; the robot stands."""
    blocked: bool = False
    """Something is in the way; the robot stands."""


class Pursuit:
    """Follows one path after another; a new path goes on at the speed of the last one."""

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self._path: Sequence[Pose] = ()
        self._at = 0
        self._turning_to_goal = False
        self._last = Command()

    def follow(self, path: Sequence[Pose]) -> None:
        """Follow this path from now on. Raises ValueError for an empty one."""
        if not path:
            raise ValueError("a path needs at least one pose")
        if not self._path or path[-1] != self._path[-1]:
            # A new plan to the same goal must not make it drive again when it has arrived and only turns.
            self._turning_to_goal = False
        self._path, self._at = path, 0

    def forget(self) -> None:
        """There is no path any more, and the robot stands."""
        self._path, self._last, self._turning_to_goal = (), Command(), False

    def limited(self, speed: float) -> None:
        """Change the speed that is driven at most, in m/s."""
        self.limits = replace(self.limits, desired_linear_vel=speed)

    @property
    def left(self) -> float:
        """Length of the path that is left, in m."""
        rest = self._path[self._at :]
        return sum(a.distance(b) for a, b in itertools.pairwise(rest))

    def command(self, pose: Pose, obstacles: NDArray[np.float32], period: float) -> Command:
        """The next command.

        Args:
            pose: where the robot is, in the path's frame.
            obstacles: what the laser sees, n by 2, in m from the robot's centre and in its frame.
            period: s since the last command.
        """
        limits, goal = self.limits, self._path[-1]
        self._advance(pose)
        distance = pose.distance(goal)
        if distance <= limits.xy_goal_tolerance:
            self._turning_to_goal = True
        elif distance > 2.5 * limits.xy_goal_tolerance:
            self._turning_to_goal = False
        if self._turning_to_goal:
            off = wrapped(goal.heading - pose.heading)
            if abs(off) <= limits.yaw_goal_tolerance:
                self._last = Command(reached=True)
                return self._last
            return self._turn(off, period)
        target = self._ahead(pose)
        bearing = wrapped(math.atan2(target.y - pose.y, target.x - pose.x) - pose.heading)
        if abs(bearing) > limits.rotate_to_heading_min_angle:
            return self._turn(bearing, period)
        reach = max(pose.distance(target), 1e-3)
        curvature = 2 * math.sin(bearing) / reach
        speed = self._regulated(curvature, distance, obstacles)
        speed = min(speed, self._last.linear + limits.max_linear_accel * period)
        if self._hits(speed, curvature, obstacles):
            slow = limits.regulated_linear_scaling_min_speed
            if speed > slow and not self._hits(slow, curvature, obstacles):
                speed = slow
            else:
                self._last = Command(blocked=True)
                return self._last
        self._last = Command(speed, speed * curvature)
        return self._last

    def _advance(self, pose: Pose) -> None:
        """Moves on to the nearest pose of the path that is not far ahead, so that a loop is not cut short."""
        best, here = self._at, self._path[self._at].distance(pose)
        travelled = 0.0
        for number in range(self._at + 1, len(self._path)):
            travelled += self._path[number - 1].distance(self._path[number])
            if travelled > 2 * self.limits.max_lookahead_dist:
                break
            distance = self._path[number].distance(pose)
            if distance <= here:
                best, here = number, distance
        self._at = best

    def _ahead(self, pose: Pose) -> Pose:
        limits = self.limits
        lookahead = min(
            limits.max_lookahead_dist, max(limits.min_lookahead_dist, self._last.linear * limits.lookahead_time)
        )
        for point in self._path[self._at :]:
            if point.distance(pose) >= lookahead:
                return point
        return self._path[-1]

    def _regulated(self, curvature: float, to_goal: float, obstacles: NDArray[np.float32]) -> float:
        limits = self.limits
        speed = limits.desired_linear_vel
        radius = 1 / abs(curvature) if curvature else math.inf
        if radius < limits.regulated_linear_scaling_min_radius:
            speed *= radius / limits.regulated_linear_scaling_min_radius
        if len(obstacles):
            # Only what is ahead: a wall that was passed is no reason to be slow.
            ahead = obstacles[obstacles[:, 0] > 0]
            if len(ahead):
                space = float(np.hypot(ahead[:, 0], ahead[:, 1]).min()) - limits.robot_radius
                if space < limits.slow_within:
                    speed *= max(space, 0.0) / limits.slow_within
        speed = max(speed, limits.regulated_linear_scaling_min_speed)
        if to_goal < limits.approach_velocity_scaling_dist:
            approach = limits.desired_linear_vel * to_goal / limits.approach_velocity_scaling_dist
            speed = min(speed, max(approach, limits.min_approach_linear_velocity))
        return speed

    def _turn(self, off: float, period: float) -> Command:
        limits = self.limits
        most = min(
            limits.rotate_to_heading_angular_vel,
            abs(self._last.angular) + limits.max_angular_accel * period,
            # Slow enough to stop at the heading.
            math.sqrt(2 * 0.5 * limits.max_angular_accel * abs(off)),
        )
        # It stops first, since a robot that turns at speed goes where it does not look.
        linear = max(0.0, self._last.linear - 2 * limits.max_linear_accel * period)
        self._last = Command(linear if linear > 0.01 else 0.0, math.copysign(most, off))
        return self._last

    def _hits(self, speed: float, curvature: float, obstacles: NDArray[np.float32]) -> bool:
        """Whether something comes nearer than it may while this is driven for the time that is looked ahead."""
        if not len(obstacles):
            return False
        limits = self.limits
        keep = limits.robot_radius + limits.collision_margin
        length = speed * limits.max_allowed_time_to_collision
        near = obstacles[np.abs(obstacles).max(axis=1) < length + keep]
        if not len(near):
            return False
        # What is within already and gets no nearer is no reason to stand: it could not ever leave.
        now = np.hypot(near[:, 0], near[:, 1])
        along = np.linspace(0.0, length, max(2, math.ceil(length / 0.04)) + 1)[1:]
        if abs(curvature) < 1e-4:
            x, y = along, np.zeros_like(along)
        else:
            x, y = np.sin(along * curvature) / curvature, (1 - np.cos(along * curvature)) / curvature
        later = np.hypot(near[:, 0, None] - x, near[:, 1, None] - y)
        return bool(((later < keep) & (later < now[:, None] - 1e-3)).any())
