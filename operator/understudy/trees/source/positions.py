"""Positions in texts: where a text begins in its file, and where it is malformed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

Place = TypeVar("Place")


@dataclass(frozen=True)
class TextOffset:
    """Where a text begins in the file that contains it; zero for a text that is a whole file."""

    lines: int = 0
    """Lines of the file before it."""
    columns: int = 0
    """Characters before each of its lines."""


WHOLE_FILE = TextOffset()


class Malformed(ValueError):
    """A text is malformed, or is refused before it is parsed."""

    def __init__(self, message: str, line: int = 1, column: int = 1) -> None:
        super().__init__(message)
        self.message, self.line, self.column = message, line, column


_LAST = re.compile(r"(\.[^.\[]*|\[\d+\])$")


def nearest(places: Mapping[str, Place], path: str) -> Place | None:
    """Return the position at a path, or of the closest parent that has one."""
    while path not in places and (shorter := _LAST.sub("", path)) != path:
        path = shorter
    return places.get(path)
