"""What the robot writes down: one JSON record per line, to standard output and to a file.

The file is there since a kubelet cuts and rotates what containers print; it is itself bounded, by one older file.
"""

from __future__ import annotations

import json
import os
from pathlib import Path


class Journal:
    """Appends records; keeps at most two files of ``limit`` bytes. A file that cannot be written is said once."""

    def __init__(self, path: str | None, *, limit: int = 64 * 1024 * 1024) -> None:
        self._path = Path(path) if path else None
        self._limit = limit
        self._file: int | None = None
        self._size = 0
        if self._path is not None:
            self._open(self._path)

    def _open(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        self._size = os.fstat(self._file).st_size

    def write(self, event: str, **values: float | int | str | bool) -> None:
        """Write one record."""
        rounded = {k: round(v, 6) if isinstance(v, float) else v for k, v in values.items()}
        line = json.dumps({"event": event} | rounded, separators=(",", ":"))
        print(line, flush=True)
        if self._file is None or self._path is None:
            return
        try:
            # One write per line, so that a reader of the file never sees half a record of ours.
            self._size += os.write(self._file, line.encode() + b"\n")
            if self._size >= self._limit:
                os.close(self._file)
                self._path.replace(self._path.with_name(self._path.name + ".1"))
                self._open(self._path)
        except OSError as error:
            self._file = None
            print(json.dumps({"event": "journal", "error": f"{self._path}: {error}"}), flush=True)
