"""What a leaf of the short form stands for, before it has its place in a tree, and the keys that most of them share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.api.ros_names import ROS_NAME_PATTERN, ROS_TYPE_PATTERN
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import Leaf
from understudy.trees.core.observations import Glance
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.source.expressions import Fields
from understudy.trees.source.value_reader import Reader, duration_of

FORETOLD = 0.1
"""Seconds that lie between two looks of the monitor at most: what takes as long to be a failure is known of in time."""

Make = Callable[[str, Glance, Sequence[TaskActive]], Leaf]
"""Makes a leaf by its path, the glance it looks through, and the tasks that it is for."""


@dataclass(frozen=True)
class LeafPlan:
    """A leaf that was read."""

    name: str
    """What it is called where the tree gives it no name."""
    watched: WatchedTopic
    """What it needs of its topic."""
    make: Make
    task: TaskActive | None = None
    """What it is judged for wherever it stands, where it is about that task itself."""
    also: tuple[WatchedTopic, ...] = ()
    """What it needs of other topics. Where one of them can't be watched, it is left out too."""


@dataclass(frozen=True)
class LeafKind:
    """A kind of leaf of the short form."""

    keys: tuple[str, ...]
    example: str
    read: Callable[[Reader, Mapping[str, Any], str, Fields | None], LeafPlan | None]
    """Reads its mapping, whose place is given, by the fields of message types; notes problems, and is None then."""
    of_control: bool = False
    """Whether it says something of the instance in control alone: a procedure can't wait for it, since it is for one that is
    to be."""


def topic_of(reader: Reader, value: Mapping[str, Any], path: str, example: str, key: str = "topic") -> str | None:
    """The topic that a leaf is about."""
    if key not in value:
        reader.problem(f"{path}.{key}", f"missing; give the topic's fully qualified name, such as {example}")
    return reader.matching(value, key, path, ROS_NAME_PATTERN, f"a fully qualified topic name such as {example}")


def node_of(
    reader: Reader, value: Mapping[str, Any], path: str, key: str = "node", *, required: bool = True
) -> str | None:
    """The node that a leaf is about, fully qualified."""
    if required and key not in value:
        reader.problem(f"{path}.{key}", "missing; give the node's fully qualified name, such as /controller_server")
    return reader.matching(
        value, key, path, ROS_NAME_PATTERN, "a node's fully qualified name such as /controller_server"
    )


def type_of(reader: Reader, value: Mapping[str, Any], path: str) -> str | None:
    """The type of the topic's messages."""
    return reader.matching(value, "type", path, ROS_TYPE_PATTERN.replace("(msg|srv|action)", "msg"), "package/msg/Name")


def hold_off_of(reader: Reader, value: Mapping[str, Any], path: str) -> float:
    """``for``: how long a condition must not hold to be a failure, in seconds; 0 where it isn't given."""
    return reader.given(value, "for", path, duration_of) or 0.0


def at_once(hold_off: float) -> bool:
    """Whether a message may be a failure as it comes, or too soon after it for the next look."""
    return hold_off < FORETOLD
