"""Keeps the odometry for the time of each kept pose, so that the pose can be propagated to the present.

A restored pose is from before the failure, and the robot may have driven since. Odometry measured that motion, which brings the pose to the
present. Each version of a kept pose needs one moment of odometry. It is determined when the pose arrives, so that only seconds of odometry
are remembered. If odometry starts again, all moments are lost, and the monitor reports why.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

from understudy.api.kinds.state_spec import CarriedBy, State
from understudy.api.protocol.kept_state import KeptSample, KeptState, Motion, NotRestored
from understudy.kinematics.odometry_track import BLIND, Moment, Point, Track
from understudy.kinematics.pose_decoding import read, stamp_of
from understudy.kinematics.poses import Pose
from understudy.state.state_capture import Key, Version

_logger = logging.getLogger(__name__)

PATIENCE = 1.0
"""Maximum delay, in seconds, of the odometry for the time of a pose."""

_SECOND = 1e-9
_MOMENT = struct.Struct("<q10d")
_NOTHING = "no message has arrived on that topic"
_UNREADABLE = "its message cannot be read"


@dataclass
class _Odometry:
    """One odometry topic."""

    track: Track = field(default_factory=Track)
    problem: str = _NOTHING
    """Why no odometry is known; empty if some is."""
    restart: str = ""
    """Why the odometry started again last; empty if it never did."""


@dataclass
class _Pose:
    """One kept topic."""

    by: CarriedBy
    moments: dict[int, Moment] = field(default_factory=dict)
    """The moments of odometry for messages, by the time that the message refers to."""
    waiting: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Messages whose odometry may still arrive, by the time that they refer to: the stamp, and when the message arrived."""


class Carrier:
    """Propagates the poses that a policy keeps. Integer times are in ns, float times in Unix seconds."""

    def __init__(self) -> None:
        self._poses: dict[str, _Pose] = {}
        self._odometry: dict[str, _Odometry] = {}
        self.revision = 0
        """Grows whenever data that must survive a restart changes."""

    def follow(self, state: State) -> None:
        """Propagate the poses of this policy. Data of poses that the old policy propagated by the same odometry stays."""
        wanted = {topic.topic: topic.carried_by for topic in state.keep if topic.carried_by is not None}
        before, self._poses = self._poses, {}
        for name, by in wanted.items():
            known = before.get(name)
            same = known is not None and (known.by.topic, known.by.type) == (by.topic, by.type)
            self._poses[name] = replace(known, by=by) if known is not None and same else _Pose(by)
        self._odometry = {topic: self._odometry.get(topic, _Odometry()) for topic in self.topics}

    @property
    def topics(self) -> Mapping[str, str]:
        """The odometry topics that are needed, with their types."""
        return {pose.by.topic: pose.by.type for pose in self._poses.values()}

    @property
    def poses(self) -> Collection[str]:
        """The kept topics whose poses are propagated."""
        return self._poses.keys()

    # -- taking in --------------------------------------------------------------------------------------------------

    def kept(self, topic: str, data: bytes, *, taken_at: float) -> None:
        """Record a message that may be kept."""
        pose = self._poses.get(topic)
        if pose is None:
            return
        try:
            stamp = stamp_of(data)
        except ValueError:
            return  # such a message cannot be restored either
        time_ = _time(stamp, taken_at)
        if time_ not in pose.moments:
            pose.waiting[time_] = (stamp, round(taken_at / _SECOND))

    def moved(self, topic: str, type_name: str, data: bytes, *, received_at: float, writer: bytes) -> None:
        """Record a message of odometry."""
        odometry = self._odometry.get(topic)
        if odometry is None:
            return
        try:
            reading = read(type_name, data)
        except ValueError as error:
            odometry.problem = f"{_UNREADABLE}: {error}"
            return
        odometry.problem = ""
        point = Point(reading.pose, reading.stamp, round(received_at / _SECOND), reading.frame, reading.child, writer)
        if reason := odometry.track.add(point):
            if reason != odometry.restart:
                _logger.warning("odometry on %s restarted: %s", topic, reason)
            odometry.restart = reason
            for pose in self._poses.values():
                if pose.by.topic == topic:
                    pose.moments.clear()
            self.revision += 1

    @property
    def waiting(self) -> int:
        """Return the number of kept messages whose odometry may still come."""
        return sum(len(pose.waiting) for pose in self._poses.values())

    def note(self, problems: Mapping[str, str]) -> None:
        """Set, by topic, why no odometry can arrive."""
        for topic, odometry in self._odometry.items():
            if topic in problems:
                odometry.problem = problems[topic]
            elif odometry.track.last is not None and not odometry.problem.startswith(_UNREADABLE):
                odometry.problem = ""

    def settle(self, now: float) -> None:
        """Determine the moments of odometry for the messages that have arrived, as far as the odometry is known by now."""
        for pose in self._poses.values():
            for time_, (stamp, taken_at) in list(pose.waiting.items()):
                late = now - taken_at * _SECOND > PATIENCE
                moment = self._odometry[pose.by.topic].track.at(stamp, taken_at, last=late)
                if moment is not None:
                    pose.moments[time_] = moment
                    self.revision += 1
                if moment is not None or late:
                    del pose.waiting[time_]

    def prune(self, versions: Mapping[Key, Iterable[Version]]) -> None:
        """Drop the moments of versions that are not kept."""
        for topic, pose in self._poses.items():
            kept = {_time_of(v.data, v.taken_at) for v in versions.get(Key("Topic", topic), ())} | pose.waiting.keys()
            pose.moments = {time_: moment for time_, moment in pose.moments.items() if time_ in kept}

    # -- giving out -------------------------------------------------------------------------------------------------

    def carry(self, state: KeptState, now: float) -> KeptState:
        """Return the state with the motion that propagates its poses, without poses that must not be restored otherwise."""
        if not self._poses:
            return state
        samples: list[KeptSample] = []
        left_out = list(state.left_out)
        self.settle(now)
        for sample in state.samples:
            motion = self._motion(sample, now)
            if motion is not None and motion.missing and motion.required:
                left_out.append(NotRestored(sample.name, motion.missing))
            else:
                samples.append(replace(sample, motion=motion))
        return replace(state, samples=tuple(samples), left_out=tuple(left_out))

    def reasons(self, state: KeptState, now: float) -> dict[str, str]:
        """Return why poses of this state could not be propagated now, by topic."""
        found = ((sample.topic, self._motion(sample, now)) for sample in state.samples)
        return {topic: motion.missing for topic, motion in found if motion is not None and motion.missing}

    def _motion(self, sample: KeptSample, now: float) -> Motion | None:
        pose = self._poses.get(sample.topic)
        if pose is None:
            return None
        by = pose.by
        odometry = self._odometry[by.topic]
        last, present = odometry.track.last, odometry.track.present
        moment = pose.moments.get(_time_of(sample.data, sample.taken_at))
        missing = ""
        if last is None or present is None:
            missing = odometry.problem or _NOTHING
        elif moment is None:
            missing = (
                f"after the pose was recorded, {odometry.restart}"
                if odometry.restart
                else "no odometry is known for the time of the pose"
            )
        if missing or last is None or present is None or moment is None:
            return Motion(by.topic, by.type, by.required, f"the pose cannot be propagated with {by.topic}: {missing}")
        unseen = now - last.received * _SECOND
        return Motion(
            topic=by.topic,
            type=by.type,
            required=by.required,
            writer=last.writer,
            frame=last.frame,
            child=last.child,
            then=moment.pose,
            last=last.pose,
            stamp=last.stamp,
            received=last.received * _SECOND,
            driven=max(present.driven - moment.driven, moment.pose.distance(last.pose)),
            turned=max(present.turned - moment.turned, moment.pose.to(last.pose).angle),
            blind=present.blind - moment.blind + (unseen if unseen > BLIND * _SECOND else 0.0),
        )

    # -- over time --------------------------------------------------------------------------------------------------

    def shift(self, step: float) -> None:
        """Adjust all times after the clock was set by ``step`` seconds."""
        by = round(step / _SECOND)
        for odometry in self._odometry.values():
            odometry.track.shift(step)
        for pose in self._poses.values():
            # The time of a message without a stamp is by this clock.
            own = {time_ for time_, (stamp, _) in pose.waiting.items() if not stamp}
            pose.waiting = {t + by * (t in own): (s, at + by) for t, (s, at) in pose.waiting.items()}

    def packed(self, now: float) -> dict[Key, list[Version]]:
        """Return the data that must survive a restart, in the form of kept state."""
        found: dict[Key, list[Version]] = {}
        for topic, odometry in self._odometry.items():
            if data := odometry.track.pack():
                found[_track_key(topic)] = [Version(now, now, data)]
        for topic, pose in self._poses.items():
            data = b"".join(_MOMENT.pack(time_, *m.pose, *m[1:]) for time_, m in pose.moments.items())
            found[_moments_key(topic, pose.by)] = [Version(now, now, data)]
        return found

    def adopt(self, versions: Mapping[Key, Collection[Version]]) -> None:
        """Continue with the data of an earlier process. Damaged data is left out."""
        for topic, odometry in self._odometry.items():
            for version in versions.get(_track_key(topic), ()):
                try:
                    if odometry.track.last is None:
                        odometry.track = Track.unpack(version.data)
                        odometry.problem = ""
                except ValueError as error:
                    _logger.error("what is kept of %s is left out: %s", topic, error)
        for topic, pose in self._poses.items():
            for version in versions.get(_moments_key(topic, pose.by), ()):
                whole = len(version.data) % _MOMENT.size == 0
                if whole and self._odometry[pose.by.topic].track.last is not None:
                    for time_, *values in _MOMENT.iter_unpack(version.data):
                        pose.moments.setdefault(time_, Moment(Pose(*values[:7]), *values[7:]))


def _track_key(topic: str) -> Key:
    return Key("Topic", f"{topic} (odometry)")  # the names of topics have no spaces


def _moments_key(topic: str, by: CarriedBy) -> Key:
    return Key("Topic", f"{topic} (carried by {by.topic})")


def _time(stamp: int, taken_at: float) -> int:
    return stamp or round(taken_at / _SECOND)


def _time_of(data: bytes, taken_at: float) -> int:
    try:
        return _time(stamp_of(data), taken_at)
    except ValueError:
        return 0
