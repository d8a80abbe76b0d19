"""State that is kept of a healthy instance and restored to the instance that takes over."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from understudy.api.base import Duration, Model, ObjectName, ReportedText, RosName, matching, unique, with_rules
from understudy.api.conditions import Time
from understudy.api.ros_names import ROS_TYPE_MESSAGE
from understudy.kinematics.pose_decoding import ODOMETRY, POSE_TYPES

MESSAGE_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/msg/[A-Z][a-zA-Z0-9]*$"

_POSES = ", ".join(POSE_TYPES[:-1]) + f" or {POSE_TYPES[-1]}"
_IS_POSE = f"self.type in [{', '.join(repr(name) for name in POSE_TYPES)}]"


@with_rules((f"!has(self.type) || {_IS_POSE}", f"the type of the odometry must contain a pose: {_POSES}", ".type"))
class CarriedBy(Model):
    """Odometry that propagates a kept pose when the pose is restored."""

    topic: RosName
    """The robot's odometry topic, such as /odom. It must describe the motion of the same frame as the kept pose, such
    as base_link. Its publisher must keep running when the instance fails."""
    type: str = Field(default=ODOMETRY, max_length=256, description=f"Type of the odometry topic: {_POSES}.")
    required: bool = False
    """True: a pose that cannot be propagated is not restored. False: it is restored as it was kept. The condition
    StateRestored and an Event report either."""


@with_rules(
    ("has(self.restoreTo) || !has(self.confirm)", "confirm is allowed only for a topic with restoreTo", ".confirm"),
    (
        "has(self.restoreTo) || !has(self.carriedBy)",
        "carriedBy is allowed only for a topic with restoreTo",
        ".carriedBy",
    ),
    (
        f"!has(self.carriedBy) || (has(self.type) && {_IS_POSE})",
        f"carriedBy needs the type of the kept topic, and it must contain a pose: {_POSES}",
        ".type",
    ),
    (
        "!has(self.carriedBy) || self.carriedBy.topic != self.topic",
        "carriedBy names the kept topic itself: give the robot's odometry",
        ".carriedBy",
    ),
)
class KeptTopic(Model):
    """A topic whose last message is kept while the workload is healthy."""

    topic: RosName
    """Fully qualified name of the topic to keep, such as /amcl_pose."""
    type: str | None = matching(MESSAGE_TYPE_PATTERN, ROS_TYPE_MESSAGE, default=None, max_length=256)
    """Type of the topic, such as geometry_msgs/msg/PoseWithCovarianceStamped. Absent: the type is read from the ROS
    graph."""
    restore_to: RosName | None = None
    """Topic on which the kept message is published to the instance that takes over, such as /initialpose. Absent: the
    message is kept but not restored."""
    stamp: Literal["now", "kept"] = "kept"
    """Time stamp of a restored message that has a header. now: the current time. kept: the original stamp."""
    max_age: Duration = "1m"
    """A message that was older than this when the failure began is not restored. The condition StateRestored and an
    Event report that."""
    confirm: RosName | None = None
    """The restoration is complete when the new instance publishes on this topic. Absent: it is complete when the
    subscribers of restoreTo have acknowledged the message."""
    carried_by: CarriedBy | None = None
    """Propagates the pose with odometry: when the pose is restored, the robot's motion since it was recorded is added.
    Absent: the pose is restored as it was kept."""


class KeptParameters(Model):
    """Parameters of a node that are kept and restored."""

    node: RosName
    """Fully qualified name of the node, such as /controller_server."""
    names: list[Annotated[str, Field(min_length=1, max_length=256)]] = Field(min_length=1, max_length=64)
    """Names of the parameters."""


class Storage(Model):
    """Where kept state is stored."""

    claim_name: ObjectName | None = None
    """Name of a PersistentVolumeClaim in the same namespace. Absent: an emptyDir, which survives a restart of the
    monitor's container but not the deletion of its pod."""


@with_rules(
    unique("keep", "topic", "keep contains the same topic twice"),
    unique("parameters", "node", "parameters contains the same node twice: list all of its parameters in one entry"),
)
class State(Model):
    """Which state of a healthy instance is kept, how often and how much."""

    keep: list[KeptTopic] = Field(default_factory=list, max_length=16)
    """Topics whose last message is kept."""
    parameters: list[KeptParameters] = Field(default_factory=list, max_length=16)
    """Parameters that are kept."""
    lifecycle: list[RosName] = Field(default_factory=list, max_length=32)
    """Managed nodes whose lifecycle state is kept. The instance that takes over is brought to the same states, in this
    order."""
    margin: Duration = "500ms"
    """Only state that was kept at least this long before the failure began is restored, because newer state may already
    be wrong."""
    period: Duration = "200ms"
    """Minimum time between two kept messages of a topic."""
    max_bytes: int = Field(default=16 * 1024 * 1024, ge=1024, le=256 * 1024 * 1024)
    """Maximum size of all kept state in bytes. A message that does not fit is not kept, and the condition StateKept
    reports that."""
    within: Duration = "5s"
    """The restoration fails if it takes longer than this."""
    storage: Storage = Field(default_factory=Storage)
    """Where kept state is stored."""


class KeptStatus(Model):
    """One item of kept state."""

    name: str
    """Name of the topic, or of the node for parameters and lifecycle states."""
    kind: Literal["Topic", "Parameters", "Lifecycle"]
    """Topic, Parameters or Lifecycle."""
    taken_at: Time | None = None
    """When the message or value that would be restored now was recorded."""
    bytes: int = 0
    """Size in bytes."""
    message: ReportedText = ""
    """What is wrong with the item, if anything."""


class RestoredState(Model):
    """Result of the restoration of one item of kept state."""

    name: str
    """Name of the topic, or of the node and the kind of its state."""
    restored: bool
    """True if the instance that took over received it."""
    age_seconds: float | None = None
    """Age at the beginning of the failure, in seconds."""
    carried_metres: float | None = None
    """Distance over which the pose was propagated, from the kept pose to the restored one, in metres. Absent if the
    pose was not propagated."""
    message: ReportedText = ""
    """Why the item was not restored or not propagated, or what is uncertain about it."""
