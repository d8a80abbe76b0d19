"""The declaration of a leaf, and the plan that is read from a tree that uses it.

A leaf's module declares one :class:`LeafKind`. The loaders, the three languages, their libraries and the reference page
are derived from that declaration: no other module names a leaf, except the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import Leaf, LeafPlace
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.source.expressions import Fields
from understudy.trees.source.value_reader import Read, Reader, duration_of, name_of, type_of, word_of

EVALUATION_INTERVAL = 0.1
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
    read: Read = str
    """Converts the value in the short form."""
    missing: str = ""
    """What to give if the value is missing; empty if the key may be left out."""

    @property
    def port(self) -> str:
        """The port in XML."""
        return self.xml or self.name


class LeafValues:
    """The values that a tree gives a leaf, by key. A value that is not given or has a problem is the default or None."""

    def __init__(
        self, reader: Reader, keys: Sequence[Key], written: Mapping[str, Any], path: str, fields: Fields | None
    ) -> None:
        """Read the values, and note their problems. ``fields`` are those of message types."""
        self.fields = fields
        self._reader, self._written, self._path = reader, written, path
        self._values: dict[str, Any] = {}
        for key in keys:
            if key.name in written:
                self.convert(key.name, key.read)
            elif key.missing:
                self.problem(key.name, f"missing; {key.missing}")
            else:
                self._values[key.name] = key.read(key.default) if key.default else None

    def __getitem__(self, key: str) -> Any:
        return self._values.get(key)

    def __contains__(self, key: str) -> bool:
        """Whether the tree gives the key."""
        return key in self._written

    @property
    def hold_off(self) -> float:
        """The seconds of ``for``: how long a condition must not hold before that is a failure; 0 if it is not given."""
        return self["for"] or 0.0

    def convert(self, key: str, read: Read) -> None:
        """Convert the written value of a key, for example with the help of the others."""
        self._values[key] = self._reader.optional(self._written, key, self._path, read)

    def problem(self, key: str, message: str) -> None:
        """Note a problem with a key; an empty key stands for the leaf itself."""
        self._reader.problem(f"{self._path}.{key}" if key else self._path, message)


@dataclass(frozen=True)
class LeafPlan:
    """A leaf that was read from a tree and does not have its place in the tree yet."""

    name: str
    """The name of the leaf if the tree does not give one."""
    watched: WatchedTopic
    """What it needs of its topic."""
    make: Callable[[LeafPlace], Leaf]
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
    plan: Callable[[LeafValues], LeafPlan]
    """Returns the plan of a leaf whose values have no problem. Raises ValueError if there cannot be such a leaf."""
    check: Callable[[LeafValues], None] = lambda values: None
    """Notes problems of values that depend on each other."""
    active_only: bool = False
    """Whether it judges the active instance only. A procedure cannot wait for it, because it prepares another instance."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys in the short form."""
        return tuple(key.name for key in self.arguments)

    def read(self, reader: Reader, value: Mapping[str, Any], path: str, fields: Fields | None) -> LeafPlan | None:
        """Read its mapping at the given path, with the fields of message types. If there are problems, note them and
        return None."""
        before = len(reader.problems)
        reader.known(value, self.keys, path)
        values = LeafValues(reader, self.arguments, value, path, fields)
        self.check(values)
        if len(reader.problems) > before:
            return None
        try:
            return self.plan(values)
        except ValueError as error:
            reader.problem(path, str(error))
            return None


# -- keys that most leaves share --------------------------------------------------------------------------------------


def topic_key(example: str, about: str = "", *, name: str = "topic", default: str = "", xml: str = "") -> Key:
    """Return a key with a topic as its value. A tree may omit a key with a default."""
    return Key(
        name,
        about or f"the topic, fully qualified, such as {example}",
        default=default,
        xml=xml,
        read=name_of("topic", example),
        missing="" if default else f"give the topic's fully qualified name, such as {example}",
    )


TYPE = Key("type", "package/msg/Name", read=type_of("msg"))


def node_key(about: str, *, name: str = "node", xml: str = "", required: bool = True) -> Key:
    """Return a key with a node as its value."""
    missing = "give the node's fully qualified name, such as /controller_server" if required else ""
    return Key(name, about, xml=xml, read=name_of("node", "/controller_server"), missing=missing)


def time_key(name: str, about: str, *, default: str = "", missing: str = "") -> Key:
    """Return a key with a duration as its value."""
    return Key(name, about, "time", default=default, read=duration_of, missing=missing)


def word_key(name: str, about: str, type_: str, members: Sequence[str], *, default: str = "", missing: str = "") -> Key:
    """Return a key with one of some words as its value; ``type_`` is the name of the enum in OpenSCENARIO 2."""
    return Key(name, about, type_, tuple(members), default, read=word_of(members), missing=missing)


def fails_on_arrival(hold_off: float) -> bool:
    """Return whether a message can be a failure when it arrives, or before the next regular evaluation."""
    return hold_off < EVALUATION_INTERVAL
