"""Converts plain mappings, as trees and requests contain them, to ROS messages, and back.

rosidl_runtime_py does the same, but loads a template engine (see ros/runtime/lean_imports.py), and its errors name no
field.
"""

from __future__ import annotations

import difflib
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.ros.runtime.interface_types import interface_class

NOW = "now"
"""The value that stands for the current time in a field of type builtin_interfaces/Time."""

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, \d+)?>")
_ARRAY = re.compile(r"(.+)\[\d+\]")
_NESTED = re.compile(r"[A-Za-z]\w*/[A-Z]\w*")
_REAL = ("float", "double")


class MessageError(ValueError):
    """A mapping that does not fit its type. The text names the field, what was found and what is expected."""


def to_message(cls: Any, values: Mapping[str, Any], *, path: str = "") -> Any:
    """Return a message of a class with the given fields; the others keep their defaults. Raises MessageError."""
    message = cls()
    fill(message, values, path=path)
    return message


def fill(message: Any, values: Mapping[str, Any], *, path: str = "") -> None:
    """Set fields of a message. Raises MessageError."""
    name = type(message).__name__
    if not isinstance(values, Mapping):
        raise MessageError(f"{path or name}: expected a mapping of the fields of {name}, found {values!r}")
    types: dict[str, str] = message.get_fields_and_field_types()
    message._check_fields = True
    for field, value in values.items():
        place = f"{path}.{field}" if path else str(field)
        if field not in types:
            close = difflib.get_close_matches(str(field), types, n=1)
            known = f"did you mean {close[0]}?" if close else f"there are {', '.join(types) or 'no fields'}"
            raise MessageError(f"{place}: {name} has no field {field}; {known}")
        wanted = _converted(types[field], value, place)
        try:
            setattr(message, field, wanted)
        except (AssertionError, TypeError, ValueError, OverflowError):
            raise MessageError(f"{place}: expected {types[field]}, found {value!r:.100}") from None


def _converted(type_name: str, value: Any, path: str) -> Any:
    """Return a value in the form that the field's setter accepts."""
    of_items = _SEQUENCE.fullmatch(type_name) or _ARRAY.fullmatch(type_name)
    if of_items:
        if isinstance(value, bytes | bytearray) and of_items[1] in ("uint8", "octet"):
            value = list(value)
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise MessageError(f"{path}: expected a list ({type_name}), found {value!r:.100}")
        return [_converted(of_items[1], item, f"{path}[{index}]") for index, item in enumerate(value)]
    if _NESTED.fullmatch(type_name):
        if type_name == "builtin_interfaces/Time" and value == NOW:
            return now()
        nested = interface_class(type_name.replace("/", "/msg/"))
        if isinstance(value, nested):
            return value
        return to_message(nested, value, path=path)
    if type_name in _REAL and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type_name == "octet" and isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 256:
        return bytes([value])
    if type_name.startswith(("int", "uint")) and isinstance(value, bool):
        return _refuse(type_name, value, path)
    return value


def _refuse(type_name: str, value: Any, path: str) -> Any:
    raise MessageError(f"{path}: expected {type_name}, found {value!r:.100}")


def now() -> Any:
    """Return the current time as a builtin_interfaces/msg/Time."""
    whole, rest = divmod(time.time_ns(), 1_000_000_000)
    return interface_class("builtin_interfaces/msg/Time")(sec=whole, nanosec=rest)


def to_mapping(message: Any) -> dict[str, Any]:
    """Return all fields of a message as plain Python values; bytes stay bytes."""
    return {field: _plain(getattr(message, field)) for field in message.get_fields_and_field_types()}


def _plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return to_mapping(value)
    if isinstance(value, str | bytes | bool | int | float):
        return value
    if hasattr(value, "tolist"):  # numpy arrays and arrays of the array module
        return value.tolist()
    return [_plain(item) for item in value]
