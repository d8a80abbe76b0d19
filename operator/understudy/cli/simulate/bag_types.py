"""The message types of a bag: from the definitions in the bag, or else from ROS 2 Jazzy.

Messages look to the trees like rclpy's own classes, so ROS need not be installed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_BREAK = "=" * 80 + "\n"
"""Separates the definition of a type from those of its fields' types."""

_NO_FIELDS = "structure_needs_at_least_one_member"
"""The field that rosidl adds to a message without fields."""

_NAMES = {"float64": "double", "float32": "float", "bool": "boolean", "byte": "octet", "char": "uint8"}
"""Basic types whose names in rosidl's Python classes differ from message files."""


class Definitions:
    """Message types by name (``package/msg/Name``)."""

    def __init__(self, connections: Iterable[Connection]) -> None:
        """Read the definitions of recorded connections. An unreadable definition is ignored."""
        written = get_typestore(Stores.EMPTY)
        for connection in connections:
            # Two topics may have different definitions of one type; use the first.
            found = _written(connection) if connection.msgtype not in written.fielddefs else {}
            if new := {name: found[name] for name in found.keys() - written.fielddefs.keys()}:
                written.register(new)
        self._sources = [_Types(written), _Types(get_typestore(Stores.ROS2_JAZZY))]

    def fields(self, type_name: str) -> Mapping[str, str] | None:
        """Return the fields of a type with rosidl's names of their types; None if the type is unknown."""
        return next((found for source in self._sources if (found := source.fields(type_name)) is not None), None)

    def read(self, data: bytes, type_name: str) -> object:
        """Deserialize a message (CDR with its header). Raises various errors for invalid bytes."""
        source = next(source for source in self._sources if source.fields(type_name) is not None)
        return source.read(data, type_name)


class _Types:
    """Message types from one source."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._fields: dict[str, Mapping[str, str] | None] = {}
        self._views: dict[str, type[_View]] = {}

    def fields(self, type_name: str) -> Mapping[str, str] | None:
        """As in :class:`Definitions`."""
        if type_name not in self._fields:
            known = self._store.fielddefs.get(type_name)
            self._fields[type_name] = (
                {name: _rosidl(description) for name, description in known[1] if name != _NO_FIELDS} if known else None
            )
        return self._fields[type_name]

    def read(self, data: bytes, type_name: str) -> object:
        """As in :class:`Definitions`."""
        return self.viewed(self._store.deserialize_cdr(data, type_name))

    def viewed(self, value: Any) -> Any:
        """Convert a value to what rclpy would return."""
        name = getattr(value, "__msgtype__", None)
        if name is not None:
            return self._view(name)(value)
        if isinstance(value, list):
            return [self.viewed(item) for item in value]
        if getattr(getattr(value, "dtype", None), "kind", "") == "b":  # numpy's booleans are not True and False
            return value.tolist()
        return value

    def _view(self, type_name: str) -> type[_View]:
        if type_name not in self._views:
            members = {"__slots__": (), "_known": self.fields(type_name) or {}, "_types": self}
            self._views[type_name] = type(type_name.rsplit("/", 1)[-1], (_View,), members)
        return self._views[type_name]


class _View:
    """A message with the interface of rclpy's: fields as attributes, and a class method that lists them."""

    __slots__ = ("_message",)
    # Fields of messages begin with a letter, so there is no conflict.
    _known: Mapping[str, str]
    _types: _Types

    def __init__(self, message: object) -> None:
        self._message = message

    @classmethod
    def get_fields_and_field_types(cls) -> Mapping[str, str]:
        """Return the fields, as rosidl's classes do."""
        return cls._known

    def __getattr__(self, name: str) -> Any:
        if name not in self._known:
            raise AttributeError(f"{type(self).__name__} has no field {name}")
        return self._types.viewed(getattr(self._message, name))


def _written(connection: Connection) -> Mapping[str, Any]:
    """Return the definitions recorded for a connection."""
    text, form = connection.msgdef.data, connection.msgdef.format
    if not text.strip():
        return {}
    try:
        if form == MessageDefinitionFormat.MSG:
            return get_types_from_msg(text, connection.msgtype)
        if form == MessageDefinitionFormat.IDL:
            parts = text.split(_BREAK)[1:] if text.startswith(f"{_BREAK}IDL: ") else [text]
            found: dict[str, Any] = {}
            for part in parts:
                found |= get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part)
            return found
    except Exception:  # it is untrusted text; ignore what cannot be read
        return {}
    return {}


def _rosidl(description: Any) -> str:
    kind, of = description
    if kind == Nodetype.BASE:
        name, most = of
        return f"{name}<{most}>" if most else _NAMES.get(name, name)
    if kind == Nodetype.NAME:
        return str(of).replace("/msg/", "/")
    item, most = of
    if kind == Nodetype.ARRAY:
        return f"{_rosidl(item)}[{most}]"
    return f"sequence<{_rosidl(item)}, {most}>" if most else f"sequence<{_rosidl(item)}>"
