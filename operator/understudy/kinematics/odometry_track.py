"""What odometry has said of late, as long as it is one motion without a break.

Odometry is only good for how the robot moved between two moments, and only while nothing has set it again in between: its
publisher was started again, a driver reset it, a filter jumped. That is looked for in each step, since afterwards nobody
could tell.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from understudy.kinematics.poses import Pose, Vector

LENGTH = 120
"""Points that are remembered. A message may be of a time that lies back a little; older moments were asked for before."""

SLACK = 100_000_000
"""Longest time after the last point, in ns, for which that point still gives the pose if no other point follows."""

BLIND = 1_000_000_000
"""ns without a point after which it was not watched meanwhile."""

FASTEST = 10.0
"""m/s that a robot is taken to move at most where nothing else is known."""

HARDEST, TWISTIEST = 30.0, 60.0
"""m/s2 and rad/s2: no robot changes its speed faster than that, unless something hits it."""

LEAST_STEP, LEAST_TURN = 0.1, 0.2
"""m and rad that are no jump in any case: odometry is corrected by a little now and then."""

MARK_STEP, MARK_TURN = 0.02, 0.02
"""m and rad from which on motion is added up: a robot that stands does not drive by its sensors' noise."""

_SECOND = 1e-9
_PACKED = struct.Struct("<7d2q16s3dH")
_FRAMES = "\n"


class Moment(NamedTuple):
    """Where odometry had the body at a time, and how far it had come by then since the track began."""

    pose: Pose
    driven: float
    """m"""
    turned: float
    """rad"""
    blind: float
    """s for which it was not watched."""


@dataclass(frozen=True)
class Point:
    """One message of odometry."""

    pose: Pose
    stamp: int
    """ns by the clock of who said it; 0 if it does not say."""
    received: int
    """ns by this machine's clock."""
    frame: str
    child: str
    writer: bytes
    """GID, 16 bytes."""


class Track:
    """One topic's odometry."""

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
        """The moment of the latest point."""
        return self._points[-1][1] if self._points else None

    def add(self, point: Point) -> str:
        """Take in what came next; why what was before cannot be joined with it, empty if it can."""
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
        seen = elapsed <= BLIND
        self._velocity = (
            ((step.x / seconds, step.y / seconds, step.z / seconds), step.angle / seconds) if seen else None
        )
        assert self._mark is not None, "it is set with the first point"
        driven, turned = self._mark.distance(point.pose), self._mark.to(point.pose).angle
        if driven < MARK_STEP and turned < MARK_TURN:
            driven = turned = 0.0
        else:
            self._mark = point.pose
        blind = 0.0 if seen else seconds
        reached = Moment(point.pose, moment.driven + driven, moment.turned + turned, moment.blind + blind)
        self._points.append((point, reached))
        return ""

    def _begin(self, point: Point) -> None:
        self._points.clear()
        self._points.append((point, Moment(point.pose, 0.0, 0.0, 0.0)))
        self._velocity, self._mark = None, point.pose

    def _break(self, last: Point, point: Point, elapsed: int) -> str:
        """Why two points are not of one motion; empty if they may be."""
        if reason := changed(last, point):
            return reason
        if elapsed < 0:
            return f"its time went back by {-elapsed * _SECOND:.3g} s"
        seconds = elapsed * _SECOND
        step = last.pose.to(point.pose)
        miss, most = last.pose.distance(point.pose), LEAST_STEP + FASTEST * seconds
        if self._velocity is not None and elapsed <= BLIND:
            (vx, vy, vz), speed = self._velocity
            ahead = Pose(vx * seconds, vy * seconds, vz * seconds, 0.0, 0.0, 0.0, 1.0)
            miss, most = ahead.distance(step), LEAST_STEP + HARDEST / 2 * seconds**2
            if abs(step.angle - speed * seconds) > LEAST_TURN + TWISTIEST / 2 * seconds**2:
                return f"it turned by {step.angle:.2f} rad within {seconds:.2f} s"
        return f"it jumped by {last.pose.distance(point.pose):.2f} m within {seconds:.2f} s" if miss > most else ""

    def at(self, stamp: int, received: int, *, last: bool = False) -> Moment | None:
        """The moment at a time, which is given by the clock of who says it (0 if it does not) and by this machine's.

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
        """This machine's clock was set by so many seconds."""
        by = round(step / _SECOND)
        moved = [
            (Point(p.pose, p.stamp, p.received + by, p.frame, p.child, p.writer), moment) for p, moment in self._points
        ]
        self._points = deque(moved, maxlen=LENGTH)

    # -- over a restart ---------------------------------------------------------------------------------------------

    def pack(self) -> bytes:
        """The last point and how far it had come, for :meth:`unpack`; empty before the first."""
        if not self._points:
            return b""
        point, moment = self._points[-1]
        frames = f"{point.frame}{_FRAMES}{point.child}".encode()
        return _PACKED.pack(*point.pose, point.stamp, point.received, point.writer, *moment[1:], len(frames)) + frames

    @classmethod
    def unpack(cls, data: bytes) -> Track:
        """A track that goes on where another ended. Raises ValueError if the bytes are none."""
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
    """What makes two messages those of different odometries, in plain words; empty if they may be of the same one."""
    if before.writer != now.writer:
        return "it comes from another publisher"
    if (before.frame, before.child) != (now.frame, now.child):
        return (
            f"its frames changed from {before.frame or 'none'} and {before.child or 'none'} to "
            f"{now.frame or 'none'} and {now.child or 'none'}"
        )
    return ""


def _elapsed(before: Point, now: Point) -> int:
    return now.stamp - before.stamp if before.stamp and now.stamp else now.received - before.received


def _between(before: Moment, after: Moment, part: float) -> Moment:
    counts = (a + part * (b - a) for a, b in zip(before[1:], after[1:], strict=True))
    return Moment(before.pose.towards(after.pose, part), *counts)
