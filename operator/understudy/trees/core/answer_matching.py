"""Compares an answer with the fields that a tree expects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def mismatch(found: Mapping[str, Any], expected: Mapping[str, Any], *, path: str = "") -> str | None:
    """Return the first expected field that differs, in words; None if all match. Fields that are not named may have any value."""
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
