"""State that is kept of a healthy instance and given to the one that takes over."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from understudy.api.base import Duration, Model, ObjectName, RosName, matching, rules
from understudy.api.conditions import Time
from understudy.api.ros_names import ROS_TYPE_MESSAGE
from understudy.kinematics.pose_decoding import ODOMETRY, POSE_TYPES

MESSAGE_TYPE_PATTERN = r"^[a-zA-Z][a-zA-Z0-9_]*/msg/[A-Z][a-zA-Z0-9]*$"

_POSES = ", ".join(POSE_TYPES[:-1]) + f" or {POSE_TYPES[-1]}"
_IS_POSE = f"self.type in [{', '.join(repr(name) for name in POSE_TYPES)}]"


class CarriedBy(Model):
    """Odometry by which a kept pose is brought to the present when it is restored."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (f"!has(self.type) || {_IS_POSE}", f"odometry has a type with a pose: {_POSES}", ".type"),
        )
    }

    topic: RosName = Field(
        description="The robot's odometry, such as /odom: of the same body as the pose, and published by what outlasts the "
        "instance."
    )
    type: str = Field(default=ODOMETRY, max_length=256, description=f"Its type: {_POSES}.")
    required: bool = Field(
        default=False,
        description="A pose that can't be carried is not restored. Otherwise it is restored as it was kept, and that is reported.",
    )


class KeptTopic(Model):
    """A topic whose last healthy message is kept, as serialized bytes with its type and times."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            ("has(self.restoreTo) || !has(self.confirm)", "confirm is only for a topic with restoreTo", ".confirm"),
            (
                "has(self.restoreTo) || !has(self.carriedBy)",
                "carriedBy is only for a topic with restoreTo",
                ".carriedBy",
            ),
            (
                f"!has(self.carriedBy) || (has(self.type) && {_IS_POSE})",
                f"carriedBy needs the type of what is carried, one with a pose: {_POSES}",
                ".type",
            ),
            (
                "!has(self.carriedBy) || self.carriedBy.topic != self.topic",
                "carriedBy names the topic itself: give the robot's odometry",
                ".carriedBy",
            ),
        )
    }

    topic: RosName = Field(description="Topic that is kept, fully qualified, such as /amcl_pose.")
    type: str | None = Field(
        default=None,
        pattern=MESSAGE_TYPE_PATTERN,
        max_length=256,
        description="Its type, such as geometry_msgs/msg/PoseWithCovarianceStamped; taken from the ROS graph where absent.",
        json_schema_extra=matching(MESSAGE_TYPE_PATTERN, ROS_TYPE_MESSAGE),
    )
    restore_to: RosName | None = Field(
        default=None,
        description="Topic on which the kept message is published to the instance that takes over, such as /initialpose. Absent: "
        "it is kept for trees only.",
    )
    stamp: Literal["now", "kept"] = Field(
        default="kept", description="The stamp of a message with a header when it is restored: now, or as it was kept."
    )
    max_age: Duration = Field(
        default="1m", description="A message older than this when the failure began is reported and not restored."
    )
    confirm: RosName | None = Field(
        default=None,
        description="Restored counts as done when the instance itself has published on this topic afterwards. Absent: when a "
        "subscriber has taken it in.",
    )
    carried_by: CarriedBy | None = Field(
        default=None,
        description="Odometry that tells how the robot moved since: a kept pose is brought to the present by it. Absent: it is "
        "restored as it was kept.",
    )


class KeptParameters(Model):
    """Parameters of a node that are kept and set again."""

    node: RosName = Field(description="The node, fully qualified, such as /controller_server.")
    names: list[Annotated[str, Field(min_length=1, max_length=256)]] = Field(
        min_length=1, max_length=64, description="Names of the parameters."
    )


class Storage(Model):
    """Where kept state lies."""

    claim_name: ObjectName | None = Field(
        default=None,
        description="PersistentVolumeClaim in the same namespace. Absent: an emptyDir, which outlives the monitor's container and "
        "not its pod.",
    )


class State(Model):
    """What is kept of a healthy instance, how often and how much."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "!has(self.keep) || self.keep.all(a, self.keep.exists_one(b, b.topic == a.topic))",
                "keep has the same topic twice",
                ".keep",
            ),
            (
                "!has(self.parameters) || self.parameters.all(a, self.parameters.exists_one(b, b.node == a.node))",
                "parameters has the same node twice: name all of its parameters in one entry",
                ".parameters",
            ),
        )
    }

    keep: list[KeptTopic] = Field(default_factory=list, max_length=16, description="Topics whose last message is kept.")
    parameters: list[KeptParameters] = Field(
        default_factory=list, max_length=16, description="Parameters that are kept."
    )
    lifecycle: list[RosName] = Field(
        default_factory=list,
        max_length=32,
        description="Managed nodes whose lifecycle state is kept; the instance that takes over is brought to the same states, in "
        "this order.",
    )
    margin: Duration = Field(
        default="500ms",
        description="What is restored was taken while the health tree held, at least this long before the failure began.",
    )
    period: Duration = Field(default="200ms", description="Least time between two kept messages of a topic.")
    max_bytes: int = Field(
        default=16 * 1024 * 1024,
        ge=1024,
        le=256 * 1024 * 1024,
        description="Most bytes of all that is kept; a message that doesn't fit is not kept, which is reported.",
    )
    within: Duration = Field(default="5s", description="Restoring fails when it isn't done in this time.")
    storage: Storage = Field(default_factory=Storage, description="Where kept state lies.")


class KeptStatus(Model):
    """One thing that is kept."""

    name: str = Field(description="Topic, or node of the parameters or the lifecycle state.")
    kind: Literal["Topic", "Parameters", "Lifecycle"] = Field(description="Topic, Parameters or Lifecycle.")
    taken_at: Time | None = Field(default=None, description="When the message was taken that would be restored now.")
    bytes: int = Field(default=0, description="Its size.")
    message: str = Field(default="", description="What is wrong with it, if anything.")


class RestoredState(Model):
    """What became of one thing that is kept, in a recovery."""

    name: str = Field(description="Topic, or node with what of it.")
    restored: bool = Field(description="Whether the instance that took over was given it.")
    age_seconds: float | None = Field(default=None, description="How old it was when the failure began, in seconds.")
    carried_metres: float | None = Field(
        default=None, description="How far odometry carried it to the present, in metres; absent where it didn't."
    )
    message: str = Field(
        default="", description="Why it was not restored, or was not carried, or what is uncertain about that."
    )
