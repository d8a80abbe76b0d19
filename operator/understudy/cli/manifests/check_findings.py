"""What was found in a file, as one line that editors can jump to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

LONGEST = 1000
"""Characters of a message; some repeat what was found."""


class Place(NamedTuple):
    """A place in a file; the first line and the first character of a line are 1."""

    line: int
    column: int


@dataclass(frozen=True)
class Finding:
    """One mistake, or what may be one."""

    file: str
    place: Place
    severity: Literal["error", "warning"]
    subject: str
    """Kind and name of the object; empty where it isn't about one."""
    field: str
    """Path of the field, such as ``spec.outputs[0].type``; empty where it isn't about one."""
    message: str
    """What was found and what would be right."""

    def to_wire(self) -> dict[str, str | int]:
        """It for programs, as it was found: nothing in it is cut or made fit for a terminal."""
        return {
            "file": self.file,
            "line": self.place.line,
            "column": self.place.column,
            "severity": self.severity,
            "subject": self.subject,
            "field": self.field,
            "message": self.message,
        }

    def __str__(self) -> str:
        where = f"{self.file}:{self.place.line}:{self.place.column}"
        message = self.message if len(self.message) <= LONGEST else f"{self.message[:LONGEST]}…"
        told = ": ".join(part for part in (where, self.severity, self.subject, self.field, message) if part)
        return "".join(_shown(character) for character in told)


def _shown(character: str) -> str:
    """A character as it may be in a line: what files are made to contain mustn't move the cursor of a terminal."""
    return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")
