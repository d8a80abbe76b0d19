"""Definitions of message types in the form of recordings: the text of the type, and of all types that it contains.

The text is that of the package's own message file, with its comments and constants. If the file is not installed, and
for the messages on an action's topics, the text is generated from the fields.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from understudy.ros.runtime.interface_types import message_class

_BREAK = "=" * 80
"""Separates the definition of a type from those of the types that it contains."""

_NAMES = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}
"""Basic types that have other names in rosidl's Python classes than in message files."""

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, (\d+))?>")
_ARRAY = re.compile(r"(.+)\[(\d+)\]")
_STRING = re.compile(r"(w?string)<(\d+)>")


def definition(type_name: str) -> str:
    """Return the definition of ``package/msg/Name``, or of a message of an action. Raises TypeNotInstalled."""
    parts = [_text(type_name)]
    done, left = {type_name}, list(_made_of(type_name))
    while left:
        name = left.pop(0)
        if name not in done:
            done.add(name)
            parts.append(f"{_BREAK}\nMSG: {_short(name)}\n{_text(name)}")
            left += _made_of(name)
    return "".join(parts)


def _text(type_name: str) -> str:
    return _installed(type_name) or "".join(
        f"{_written(kind)} {field}\n" for field, kind in message_class(type_name).get_fields_and_field_types().items()
    )


def _installed(type_name: str) -> str:
    package, kind, name = type_name.split("/")
    for prefix in [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]:
        try:
            text = (Path(prefix) / "share" / package / kind / f"{name}.msg").read_text()
        except (OSError, UnicodeDecodeError):
            continue
        return text if text.endswith("\n") else f"{text}\n"
    return ""


def _made_of(type_name: str) -> Iterator[str]:
    """Yield the types of its fields that are not basic ones."""
    slots: Sequence[Any] = message_class(type_name).SLOT_TYPES
    for slot in slots:
        item = getattr(slot, "value_type", slot)
        if hasattr(item, "namespaces"):
            yield "/".join((*item.namespaces, item.name))


def _short(type_name: str) -> str:
    package, _, name = type_name.split("/")
    return f"{package}/{name}"


def _written(kind: str) -> str:
    """Return a field's type in the notation of message files."""
    if found := _SEQUENCE.fullmatch(kind):
        return f"{_written(found[1])}[{f'<={found[2]}' if found[2] else ''}]"
    if found := _ARRAY.fullmatch(kind):
        return f"{_written(found[1])}[{found[2]}]"
    if found := _STRING.fullmatch(kind):
        return f"{found[1]}<={found[2]}"
    return _NAMES.get(kind, kind)
