"""Poses in the plane and how they are joined. Metres and radians, angles counter-clockwise."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from typing import NamedTuple


def wrapped(angle: float) -> float:
    """The same angle between -pi and pi."""
    return math.remainder(angle, math.tau)


class Pose(NamedTuple):
    """A place and a heading in some frame; also the transform from the frame at it into that frame."""

    x: float
    y: float
    heading: float

    def then(self, step: Pose) -> Pose:
        """Where a pose that is given in the frame at this one lies."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose(
            self.x + c * step.x - s * step.y, self.y + s * step.x + c * step.y, wrapped(self.heading + step.heading)
        )

    def inverse(self) -> Pose:
        """The transform the other way."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose(-c * self.x - s * self.y, s * self.x - c * self.y, -self.heading)

    def to(self, other: Pose) -> Pose:
        """The other pose as seen from this one."""
        return self.inverse().then(other)

    def distance(self, other: Pose) -> float:
        """Distance between the places, in m."""
        return math.hypot(other.x - self.x, other.y - self.y)


class Odometry:
    """The last seconds of odometry, to be asked for the pose at a time in between."""

    def __init__(self, *, length: int = 500) -> None:
        self._times: deque[float] = deque(maxlen=length)
        self._poses: deque[Pose] = deque(maxlen=length)

    def add(self, time: float, pose: Pose) -> None:
        """Note a pose at a time, in s. One that is not later than the last begins a new history: the source restarted."""
        if self._times and time <= self._times[-1]:
            self._times.clear()
            self._poses.clear()
        self._times.append(time)
        self._poses.append(pose)

    @property
    def latest(self) -> tuple[float, Pose] | None:
        """The newest time and pose; None before the first."""
        return (self._times[-1], self._poses[-1]) if self._times else None

    def at(self, time: float, *, slack: float = 0.5) -> Pose | None:
        """The pose at a time, or None where it lies outside what is known by more than ``slack`` s."""
        if not self._times or time < self._times[0] - slack or time > self._times[-1] + slack:
            return None
        index = bisect_left(self._times, time)
        if index == 0 or index == len(self._times):
            return self._poses[0 if index == 0 else -1]
        before, after = self._times[index - 1], self._times[index]
        part = (time - before) / (after - before)
        a, b = self._poses[index - 1], self._poses[index]
        return Pose(
            a.x + (b.x - a.x) * part,
            a.y + (b.y - a.y) * part,
            wrapped(a.heading + wrapped(b.heading - a.heading) * part),
        )
