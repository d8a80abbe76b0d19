"""Files in which a process of the demo records what happened, one JSON object per line, and how the command reads them.

Files, and not pipes: a terminal that stops reading must not delay the process that watches the robot.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

Entry = dict[str, Any]
"""One line. ``at`` is its time in seconds of the monotonic clock, which all processes of a machine share."""


class JournalWriter:
    """Appends entries to a file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a")

    def write(self, **values: Any) -> None:
        """Write one entry at once."""
        self._file.write(json.dumps({"at": time.monotonic(), **values}) + "\n")
        self._file.flush()


class JournalReader:
    """Reads a file that grows."""

    def __init__(self, path: Path) -> None:
        self._path, self._place = path, 0

    def read(self) -> list[Entry]:
        """Return the entries since the last call; none if there is no file yet."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._place)
                whole, newline, _ = file.read().rpartition(b"\n")
        except FileNotFoundError:
            return []
        self._place += len(whole) + len(newline)
        return [json.loads(line) for line in whole.splitlines()]
