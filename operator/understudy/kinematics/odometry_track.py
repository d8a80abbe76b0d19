"""The recent odometry of a topic, as long as it is one motion without a break.

Odometry only shows how the robot moved between two moments, and only if it was not reset in between: its publisher was started again, a
driver reset it, or a filter jumped. Each step is checked for that, because a reset cannot be detected later.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from understudy.kinematics.poses import Pose, Vector

LENGTH = 120
"""Number of points that are remembered. A message may refer to a time shortly before; moments of older times were requested earlier."""

SLACK = 100_000_000
"""Longest time after the last point, in ns, for which that point still gives the pose if no other point follows."""

BLIND = 1_000_000_000
"""Nanoseconds without a point after which the motion in between counts as unobserved."""

FASTEST = 10.0
"""Assumed maximum speed of a robot in m/s, if its velocity is not known."""

HARDEST, TWISTIEST = 30.0, 60.0
"""Maximum acceleration in m/s2 and rad/s2: no robot changes its speed faster, unless something hits it."""

LEAST_STEP, LEAST_TURN = 0.1, 0.2
"""Steps up to this size, in m and rad, are never jumps: odometry makes small corrections now and then."""

MARK_STEP, MARK_TURN = 0.02, 0.02
"""Minimum motion, in m and rad, that is added up, so that sensor noise does not make a standing robot drive."""

_SECOND = 1e-9
_PACKED = struct.Struct("<7d2q16s3dH")
_FRAMES = "\n"


class Moment(NamedTuple):
    """The pose of the body in odometry at a time, and its motion since the track began."""

    pose: Pose
    driven: float
    """m"""
    turned: float
    """rad"""
    blind: float
    """Seconds for which the motion was not observed."""


@dataclass(frozen=True)
class Point:
    """One message of odometry."""

    pose: Pose
    stamp: int
    """Time in ns by the publisher's clock; 0 if the message has none."""
    received: int
    """Time in ns by this machine's clock."""
    frame: str
    child: str
    writer: bytes
    """GID, 16 bytes."""


class Track:
    """The odometry of one topic."""

    def __init__(self) -> None:
        self._points: deque[tuple[Point, Moment]] = deque(maxlen=LENGTH)
        self._velocity: tuple[Vector, float] | None = None
        self._mark: Pose | None = None

    @property
    def last(self) -> Point | None:
        """The latest point; None before the first."""
        return self._points[-1][0] if self._points else None

    @property
    def present(self) -> Moment | None:
        """The moment of the latest point; None before the first."""
        return self._points[-1][1] if self._points else None

    def add(self, point: Point) -> str:
        """Add the next point. Returns why the earlier points cannot be joined with it; empty if they can."""
        if not self._points:
            self._begin(point)
            return ""
        last, moment = self._points[-1]
        elapsed = _elapsed(last, point)
        if elapsed == 0 and point.writer == last.writer:
            return ""
        reason = self._break(last, point, elapsed)
        if reason:
            self._begin(point)
            return reason
        seconds = elapsed * _SECOND
        step = last.pose.to(point.pose)
        is_observed = elapsed <= BLIND
        self._velocity = (
            ((step.x / seconds, step.y / seconds, step.z / seconds), step.angle / seconds) if is_observed else None
        )
        assert self._mark is not None, "it is set with the first point"
        driven, turned = self._mark.distance(point.pose), self._mark.to(point.pose).angle
        if driven < MARK_STEP and turned < MARK_TURN:
            driven = turned = 0.0
        else:
            self._mark = point.pose
        blind = 0.0 if is_observed else seconds
        reached = Moment(point.pose, moment.driven + driven, moment.turned + turned, moment.blind + blind)
        self._points.append((point, reached))
        return ""

    def _begin(self, point: Point) -> None:
        self._points.clear()
        self._points.append((point, Moment(point.pose, 0.0, 0.0, 0.0)))
        self._velocity, self._mark = None, point.pose

    def _break(self, last: Point, point: Point, elapsed: int) -> str:
        """Return why two points do not belong to one motion; empty if they may."""
        if reason := changed(last, point):
            return reason
        if elapsed < 0:
            return f"the time of the odometry went back by {-elapsed * _SECOND:.3g} s"
        seconds = elapsed * _SECOND
        step = last.pose.to(point.pose)
        miss, most = last.pose.distance(point.pose), LEAST_STEP + FASTEST * seconds
        if self._velocity is not None and elapsed <= BLIND:
            (vx, vy, vz), speed = self._velocity
            ahead = Pose(vx * seconds, vy * seconds, vz * seconds, 0.0, 0.0, 0.0, 1.0)
            miss, most = ahead.distance(step), LEAST_STEP + HARDEST / 2 * seconds**2
            if abs(step.angle - speed * seconds) > LEAST_TURN + TWISTIEST / 2 * seconds**2:
                return f"the odometry turned by {step.angle:.2f} rad within {seconds:.2f} s"
        return (
            f"the odometry jumped by {last.pose.distance(point.pose):.2f} m within {seconds:.2f} s"
            if miss > most
            else ""
        )

    def at(self, stamp: int, received: int, *, last: bool = False) -> Moment | None:
        """Return the moment at a time, given by the publisher's clock (``stamp``, 0 if there is none) and by this machine's clock.

        None if the time is not known. With ``last``, the last point also answers for a time shortly after it.
        """
        if not self._points:
            return None
        by_stamp = bool(stamp and self._points[-1][0].stamp)
        time = stamp if by_stamp else received
        later: tuple[int, Moment] | None = None
        for point, moment in reversed(self._points):
            at = point.stamp if by_stamp else point.received
            if at <= time:
                if later is None:
                    return moment if at == time or (last and time - at <= SLACK) else None
                return _between(moment, later[1], (time - at) / (later[0] - at))
            later = at, moment
        return None

    def shift(self, step: float) -> None:
        """Adjust the times after this machine's clock was set by ``step`` seconds."""
        by = round(step / _SECOND)
        moved = [
            (Point(p.pose, p.stamp, p.received + by, p.frame, p.child, p.writer), moment) for p, moment in self._points
        ]
        self._points = deque(moved, maxlen=LENGTH)

    # -- over a restart ---------------------------------------------------------------------------------------------

    def pack(self) -> bytes:
        """Return the last point and its moment as bytes for :meth:`unpack`; empty before the first point."""
        if not self._points:
            return b""
        point, moment = self._points[-1]
        frames = f"{point.frame}{_FRAMES}{point.child}".encode()
        return _PACKED.pack(*point.pose, point.stamp, point.received, point.writer, *moment[1:], len(frames)) + frames

    @classmethod
    def unpack(cls, data: bytes) -> Track:
        """Return a track that continues from packed bytes. Raises ValueError if they are invalid."""
        track = cls()
        if not data:
            return track
        try:
            *values, length = _PACKED.unpack_from(data)
            frame, child = data[_PACKED.size : _PACKED.size + length].decode().split(_FRAMES)
        except (struct.error, ValueError) as error:
            raise ValueError(f"{len(data)} bytes are not an odometry track: {error}") from error
        pose = Pose.of(values[:7])
        stamp, received, writer, driven, turned, blind = values[7:13]
        track._points.append((Point(pose, stamp, received, frame, child, writer), Moment(pose, driven, turned, blind)))
        track._mark = pose
        return track


def changed(before: Point, now: Point) -> str:
    """Return why two messages come from different odometry, in plain words; empty if they may come from the same."""
    if before.writer != now.writer:
        return "another publisher took over this topic"
    if (before.frame, before.child) != (now.frame, now.child):
        return (
            f"the frames of the odometry changed from {before.frame or 'none'} and {before.child or 'none'} to "
            f"{now.frame or 'none'} and {now.child or 'none'}"
        )
    return ""


def _elapsed(before: Point, now: Point) -> int:
    return now.stamp - before.stamp if before.stamp and now.stamp else now.received - before.received


def _between(before: Moment, after: Moment, part: float) -> Moment:
    counts = (a + part * (b - a) for a, b in zip(before[1:], after[1:], strict=True))
    return Moment(before.pose.towards(after.pose, part), *counts)
