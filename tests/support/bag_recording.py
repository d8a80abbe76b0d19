"""Writes bags for tests, as a recorder would write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)

START = 1_780_000_000
"""Unix seconds."""

NS = 1_000_000_000

Storage = Literal["mcap", "sqlite3"]


class RecordedMessage(NamedTuple):
    """A message, at a time in seconds from START."""

    at: float
    topic: str
    type: str
    fields: Mapping[str, Any] = {}


def every(topic: str, type_: str, begin: float, end: float, hertz: float, **fields: Any) -> list[RecordedMessage]:
    """Return messages at a rate, from one time to another."""
    return [RecordedMessage(begin + n / hertz, topic, type_, fields) for n in range(round((end - begin) * hertz))]


def message(type_: str, fields: Mapping[str, Any]) -> Any:
    """Build a message; fields that are not given are empty."""
    cls, descriptions = STORE.types[type_], STORE.fielddefs[type_][1]
    return cls(**{name: _value(description, fields.get(name)) for name, description in descriptions})


def _value(description: Any, values_given: Any) -> Any:
    import numpy

    kind, of = description
    if kind == Nodetype.NAME:
        return message(of, values_given or {})
    if kind == Nodetype.BASE:
        return (
            values_given if values_given is not None else "" if of[0] == "string" else False if of[0] == "bool" else 0
        )
    item, length = of
    values = values_given if values_given is not None else [None] * (length if kind == Nodetype.ARRAY else 0)
    if item[0] == Nodetype.NAME or item[1][0] == "string":
        return [_value(item, value) for value in values]
    return numpy.array([value or 0 for value in values], dtype=item[1][0])


def ns(at: float) -> int:
    """Convert seconds from START into the time format of a bag."""
    return START * NS + round(at * NS)


def unix(at: float) -> float:
    """Convert seconds from START into the time format of a bag's readers."""
    return ns(at) * 1e-9


def write(
    path: Path, messages: Iterable[RecordedMessage], storage: Storage = "mcap", also: Mapping[str, str] | None = None
) -> Path:
    """Write a bag folder; ``also`` lists topics with their types without any messages."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    messages = sorted(messages, key=lambda one: one.at)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        types = {one.topic: one.type for one in messages} | dict(also or {})
        connections = {topic: writer.add_connection(topic, type_, typestore=STORE) for topic, type_ in types.items()}
        for one in messages:
            data = STORE.serialize_cdr(message(one.type, one.fields), one.type)
            writer.write(connections[one.topic], ns(one.at), data)
    return path


def policy(tree: str, *, name: str = "tried", debounce: str = "0s", grace: str = "30s") -> str:
    """Return a manifest with a health tree, which is given in YAML's flow style."""
    return (
        f"apiVersion: understudy.dev/v1alpha1\nkind: FailurePolicy\nmetadata: {{name: {name}}}\nspec:\n"
        f"  monitoring: {{debounce: {debounce}, startupGrace: {grace}, yaml: {tree}}}\n"
        "  strategies: [{type: Restart}]\n"
    )
