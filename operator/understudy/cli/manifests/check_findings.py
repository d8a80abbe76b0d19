"""Findings of a check, each as one line that editors can jump to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from understudy.api.plain_text import plain

LONGEST = 1000
"""Most characters of a message; some quote the value that was found."""


class Place(NamedTuple):
    """A position in a file; lines and columns start at 1."""

    line: int
    column: int


@dataclass(frozen=True)
class Finding:
    """An error or a warning."""

    file: str
    place: Place
    severity: Literal["error", "warning"]
    subject: str
    """Kind and name of the object; empty if it does not concern one."""
    field: str
    """Path of the field, such as ``spec.outputs[0].type``; empty if it does not concern one."""
    message: str
    """What was found, and how to correct it."""

    def to_wire(self) -> dict[str, str | int]:
        """Return the finding as JSON data, neither shortened nor escaped."""
        about = {"severity": self.severity, "subject": self.subject, "field": self.field, "message": self.message}
        return {"file": self.file, **self.place._asdict(), **about}

    def __str__(self) -> str:
        where = f"{self.file}:{self.place.line}:{self.place.column}"
        message = self.message if len(self.message) <= LONGEST else f"{self.message[:LONGEST]}…"
        text = ": ".join(part for part in (where, self.severity, self.subject, self.field, message) if part)
        return plain(text)
