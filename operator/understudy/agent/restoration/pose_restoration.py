"""Propagates a kept pose to the present when it is restored, with the robot's odometry as this pod receives it.

The monitor reports the odometry at the time of the pose (state/pose_propagation.py). After that time the robot may have
driven on until it noticed that no instance controls it, and the instance may have taken long to start. Only when the
pose is published is the robot's present place known.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from understudy.api.protocol.kept_state import KeptSample, Motion
from understudy.kinematics.odometry_track import Point, Track
from understudy.kinematics.pose_decoding import ODOMETRY, Reading, read
from understudy.kinematics.poses import Pose, carried, grown

if TYPE_CHECKING:
    from understudy.ros.actions.instance_calls import InstanceCaller, Listener
    from understudy.ros.runtime.sample_taking import Sample

ODOMETRY_WITHIN = 5.0
"""Maximum seconds to wait for odometry; half of the time for restoring the pose, if that is less."""

TOLD_FROM = 1.0
"""Minimum gap in odometry, in seconds, that is reported. A shorter gap means that the process was stalled."""

_SECOND = 1e-9


@dataclass(frozen=True)
class PoseOutcome:
    """The outcome for a pose that is to be propagated."""

    metres: float | None = None
    """Distance of the propagation; None if the pose was not propagated."""
    note: str = ""
    """Why the pose was not propagated, or what is uncertain about the result."""


class PosePublication:
    """A kept message, as it is to be published now."""

    def __init__(self, sample: KeptSample, listener: Listener | None = None, missing: str = "") -> None:
        """``missing`` is the reason why a pose cannot be propagated as long as no odometry arrives."""
        self._sample, self._listener, self._missing = sample, listener, missing
        self.outcome: PoseOutcome | None = None
        """Outcome of the last publication; None for a message that is not to be propagated."""

    def message(self) -> bytes:
        """Return the message's bytes. It loads rclpy.

        Raises CallFailed, also if a pose must not be published without propagation.
        """
        from understudy.agent.restoration.kept_messages import stamped
        from understudy.ros.actions.instance_calls import CallFailed

        motion = self._sample.motion
        if motion is None:
            return stamped(self._sample)
        came = self._listener.last if self._listener is not None else None
        missing = self._missing if came is None else ""
        if came is not None:
            try:
                data, metres = self._carried(motion, came)
            except ValueError as error:
                missing = f"the pose cannot be propagated with {motion.topic}: {error}"
            else:
                note = (
                    f"{motion.topic} was missing for {motion.blind:.1f} s of the time since the pose was recorded, "
                    "so the restored pose may be inaccurate"
                )
                self.outcome = PoseOutcome(metres, note if motion.blind > TOLD_FROM else "")
                return data
        if motion.required:
            raise CallFailed(missing)
        self.outcome = PoseOutcome(None, f"{missing}; the pose was restored as it was kept")
        return stamped(self._sample)

    def _carried(self, motion: Motion, came: Sample) -> tuple[bytes, float]:
        """Return the propagated message, and the distance. Raises ValueError."""
        reading = read(motion.type, came.data)
        before = Point(
            motion.last, motion.stamp, round(motion.received / _SECOND), motion.frame, motion.child, motion.writer
        )
        # The monitor's clock may be ahead of this pod's.
        received = max(round(came.received / _SECOND), before.received)
        track = Track()
        track.add(before)
        if reason := track.add(Point(reading.pose, reading.stamp, received, reading.frame, reading.child, came.gid)):
            raise ValueError(f"after the pose was recorded, {reason}")
        driven = motion.driven + motion.last.distance(reading.pose)
        turned = motion.turned + motion.last.to(reading.pose).angle
        return composed(self._sample, motion.then, reading, driven=driven, turned=turned), driven


def composed(sample: KeptSample, then: Pose, now: Reading, *, driven: float, turned: float) -> bytes:
    """Return the message of a kept pose, moved as odometry has moved since. It loads rclpy.

    Its stamp is that of the odometry, since the robot was there at that time; or the current time, if the policy
    requires that. Raises ValueError if the message is not of its type or its pose is invalid or of another body, and
    CallFailed.
    """
    from rclpy.serialization import serialize_message

    from understudy.agent.restoration.kept_messages import deserialized
    from understudy.ros.runtime.message_values import now as present_time

    message = deserialized(sample)
    child = message.child_frame_id if sample.type == ODOMETRY else ""
    if child and now.child and child != now.child:
        raise ValueError(f"that odometry is of frame {now.child}, but {sample.topic} is of frame {child}")
    holder = message.pose if hasattr(message.pose, "covariance") else None
    pose = holder.pose if holder is not None else message.pose
    kept = _pose(pose)
    reached = carried(kept, then, now.pose)
    pose.position.x, pose.position.y, pose.position.z = reached.place
    orientation = pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = reached[3:]
    if holder is not None:
        covariance = [float(value) for value in holder.covariance]
        holder.covariance = grown(covariance, kept, reached, driven=driven, turned=turned)
    if sample.stamp == "now" or not now.stamp:
        message.header.stamp = present_time()
    else:
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now.stamp, 1_000_000_000)
    return bytes(serialize_message(message))


def _pose(pose: Any) -> Pose:
    place, turn = pose.position, pose.orientation
    return Pose.of([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])


@contextlib.asynccontextmanager
async def present(caller: InstanceCaller, sample: KeptSample, within: float) -> AsyncIterator[PosePublication]:
    """Provide a kept message for as long as it is published.

    Waits for odometry first, for a part of ``within`` seconds.
    """
    from understudy.ros.actions.instance_calls import CallFailed

    motion = sample.motion
    if motion is None or motion.missing:
        yield PosePublication(sample, missing=motion.missing if motion is not None else "")
        return
    async with contextlib.AsyncExitStack() as stack:
        listener, missing = None, ""
        try:
            listener = await stack.enter_async_context(caller.listening(motion.topic, motion.type, within))
            waited = min(ODOMETRY_WITHIN, within / 2)
            if await listener.first(waited) is None:
                missing = (
                    f"the pose cannot be propagated with {motion.topic}: no message arrived on it within {waited:.3g} s"
                )
        except CallFailed as error:
            missing = f"the pose cannot be propagated with {motion.topic}: {error}"
        yield PosePublication(sample, listener, missing)
