"""The robot's base: a unicycle with acceleration limits and a command watchdog, as real bases have them."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pose:
    """Position in m and heading in rad, counter-clockwise from the x axis."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, slots=True)
class Limits:
    """What the motors can do, in m, rad and s."""

    speed: float = 0.6
    turn: float = 1.6
    acceleration: float = 0.8
    braking: float = 1.5
    turn_acceleration: float = 4.0


def wrapped(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau


def moved(pose: Pose, speed: float, turn: float, seconds: float) -> Pose:
    """The pose after driving an arc with constant speed and turn rate."""
    heading = pose.heading + turn * seconds
    if abs(turn) < 1e-6:
        middle = pose.heading + turn * seconds / 2
        x = pose.x + speed * seconds * math.cos(middle)
        y = pose.y + speed * seconds * math.sin(middle)
    else:
        radius = speed / turn
        x = pose.x + radius * (math.sin(heading) - math.sin(pose.heading))
        y = pose.y - radius * (math.cos(heading) - math.cos(pose.heading))
    return Pose(x, y, wrapped(heading))


def approached(value: float, target: float, *, up: float, down: float) -> float:
    """One step from a speed towards another: at most ``up`` away from zero, at most ``down`` towards it.

    A reversal takes two steps at least: it brakes to zero first.
    """
    if value * target < 0 or abs(target) < abs(value):
        floor = target if value * target >= 0 else 0.0
        return max(value - down, floor) if value > 0 else min(value + down, floor)
    return min(value + up, target) if target > value else max(value - up, target)


class Base:
    """Follows the latest command; stops by itself when commands end. Times are in seconds of any steady clock."""

    def __init__(self, pose: Pose, *, now: float, limits: Limits | None = None, watchdog: float = 0.5) -> None:
        self.pose = pose
        self.speed = 0.0
        self.turn = 0.0
        self._limits = limits or Limits()
        self._watchdog = watchdog
        self._target = (0.0, 0.0)
        self._commanded: float | None = None
        self._time = now

    def command(self, linear: float, angular: float, *, now: float) -> None:
        """Take a command, cut down to what the motors can do."""
        limits = self._limits
        self._target = (
            max(-limits.speed, min(limits.speed, linear)),
            max(-limits.turn, min(limits.turn, angular)),
        )
        self._commanded = now

    def held(self, now: float) -> bool:
        """Whether the watchdog holds the base because no commands arrive (cmd_vel_timeout of ros2_controllers)."""
        return self._commanded is None or now - self._commanded > self._watchdog

    def step(self, now: float) -> Pose:
        """The pose that the base would move to by now; the caller says with :meth:`place` whether the way is free."""
        seconds = max(0.0, now - self._time)
        self._time = now
        linear, angular = (0.0, 0.0) if self.held(now) else self._target
        limits = self._limits
        self.speed = approached(self.speed, linear, up=limits.acceleration * seconds, down=limits.braking * seconds)
        turned = limits.turn_acceleration * seconds
        self.turn = approached(self.turn, angular, up=turned, down=turned)
        return moved(self.pose, self.speed, self.turn, seconds)

    def place(self, pose: Pose) -> None:
        """Be there."""
        self.pose = pose

    def bump(self) -> None:
        """Stand still: something is in the way."""
        self.speed = 0.0
        self.turn = 0.0
