"""The declaration of a leaf, and the plan that is read from a tree that uses it.

A leaf's module declares one :class:`LeafKind`. The loaders, the three languages, their libraries and the reference page
are derived from that declaration: no other module names a leaf, except the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.api.ros_names import ROS_NAME_PATTERN, ROS_TYPE_PATTERN
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import Leaf
from understudy.trees.core.observations import Evaluation
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.source.expressions import Fields
from understudy.trees.source.value_reader import Reader, duration_of

LOOK_INTERVAL = 0.1
"""The longest time in seconds between two evaluations by the monitor. A failure that takes at least this long is
scheduled in time."""


@dataclass(frozen=True)
class Key:
    """A key of a leaf or step in the short form, and its spelling in the other languages."""

    name: str
    about: str
    """One line for the reference and for editors, such as ``the longest silence, such as 500ms``."""
    type: str = "string"
    """``string``, ``int``, ``float``, ``time``, ``frequency``, ``structure``, ``names`` (a list), or the name of an enum in
    OpenSCENARIO 2."""
    members: tuple[str, ...] = ()
    """The members, if the type is an enum."""
    default: str = ""
    """The default as XML writes it; empty if there is none."""
    xml: str = ""
    """The port in XML if it differs: ``name`` is the node's own name there."""
    osc: str = ""
    """The argument in OpenSCENARIO 2 if the language's own rules do not give it."""

    @property
    def port(self) -> str:
        """The port in XML."""
        return self.xml or self.name


Make = Callable[[str, Evaluation, Sequence[TaskActive]], Leaf]
"""Makes a leaf from its path, the evaluation that provides its input, and the tasks for which it is judged."""


@dataclass(frozen=True)
class LeafPlan:
    """A leaf that was read from a tree and does not have its place in the tree yet."""

    name: str
    """The name of the leaf if the tree does not give one."""
    watched: WatchedTopic
    """What it needs of its topic."""
    make: Make
    task: TaskActive | None = None
    """The task of the leaf itself; it is judged only while this task is active."""
    also: tuple[WatchedTopic, ...] = ()
    """What it needs of other topics. If one of them cannot be watched, the leaf is left out."""


@dataclass(frozen=True)
class LeafKind:
    """A kind of leaf."""

    name: str
    """Its key in the short form; OpenSCENARIO 2 uses the same, and XML its words in CamelCase."""
    summary: str
    """When it holds, such as ``while the topic is received often enough``."""
    arguments: tuple[Key, ...]
    example: str
    """Its value in the short form, as flow-style YAML."""
    read: Callable[[Reader, Mapping[str, Any], str, Fields | None], LeafPlan | None]
    """Reads its mapping at the given path, with the fields of message types. If there are problems, it notes them and
    returns None."""
    active_only: bool = False
    """Whether it judges the active instance only. A procedure cannot wait for it, because it prepares another instance."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys in the short form."""
        return tuple(key.name for key in self.arguments)


# -- keys that most leaves share --------------------------------------------------------------------------------------


def topic_key(example: str, about: str = "", *, default: str = "") -> Key:
    """The key ``topic``."""
    return Key("topic", about or f"the topic, fully qualified, such as {example}", default=default)


TYPE = Key("type", "package/msg/Name")


def time_key(name: str, about: str, *, default: str = "") -> Key:
    """A key with a duration as its value."""
    return Key(name, about, "time", default=default)


def topic_of(reader: Reader, value: Mapping[str, Any], path: str, example: str, key: str = "topic") -> str | None:
    """Read the topic of a leaf."""
    if key not in value:
        reader.problem(f"{path}.{key}", f"missing; give the topic's fully qualified name, such as {example}")
    return reader.matching(value, key, path, ROS_NAME_PATTERN, f"a fully qualified topic name such as {example}")


def node_of(
    reader: Reader, value: Mapping[str, Any], path: str, key: str = "node", *, required: bool = True
) -> str | None:
    """Read the node of a leaf, fully qualified."""
    if required and key not in value:
        reader.problem(f"{path}.{key}", "missing; give the node's fully qualified name, such as /controller_server")
    return reader.matching(
        value, key, path, ROS_NAME_PATTERN, "a node's fully qualified name such as /controller_server"
    )


def type_of(reader: Reader, value: Mapping[str, Any], path: str) -> str | None:
    """Read the type of the topic's messages."""
    return reader.matching(value, "type", path, ROS_TYPE_PATTERN.replace("(msg|srv|action)", "msg"), "package/msg/Name")


def hold_off_of(reader: Reader, value: Mapping[str, Any], path: str) -> float:
    """Read ``for``: the seconds for which a condition must not hold before that is a failure; 0 if it is not given."""
    return reader.given(value, "for", path, duration_of) or 0.0


def fails_on_arrival(hold_off: float) -> bool:
    """Return whether a message can be a failure when it arrives, or before the next regular evaluation."""
    return hold_off < LOOK_INTERVAL
