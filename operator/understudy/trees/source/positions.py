"""Positions in texts: where a text begins in its file, and where it is malformed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

Place = TypeVar("Place")


@dataclass(frozen=True)
class TextOffset:
    """Where a text begins in the file that it is part of; its own first character, if it is a file on its own."""

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
    """The place of what a path leads to, or of the next thing around it that has one."""
    while path not in places and (shorter := _LAST.sub("", path)) != path:
        path = shorter
    return places.get(path)
