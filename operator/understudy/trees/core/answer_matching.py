"""Compares what was answered with what a tree expects of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def mismatch(found: Mapping[str, Any], expected: Mapping[str, Any], *, path: str = "") -> str | None:
    """What of the expected fields is not so, in plain words; None if all are. Fields that are not named may be anything."""
    for field, value in expected.items():
        place = f"{path}.{field}" if path else str(field)
        if field not in found:
            return f"there is no field {place}; there are {', '.join(found)}"
        present = found[field]
        if isinstance(value, Mapping) and isinstance(present, Mapping):
            if (reason := mismatch(present, value, path=place)) is not None:
                return reason
        elif present != value:
            return f"{place} is {present!r:.100}, expected {value!r:.100}"
    return None
