"""Recordings of failures on the disk. Their number and size are bounded, and none is incomplete.

A recording is a file that is named after its recovery, with a description next to it. The description is written first, and both
files are renamed into place, so that a killed monitor leaves no partial file. Files are not synced: the checksum reveals a file that
is incomplete because its node was lost.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from pydantic import ValidationError

from understudy.api.kinds.recording_spec import Recording
from understudy.process.file_replacement import NEW, replace_file, replaced_file

_logger = logging.getLogger(__name__)


class TooBig(Exception):
    """A recording is larger than all recordings together may be."""


class RecordingArchive:
    """A folder of recordings. It is created with the first recording."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._kept: list[Recording] | None = None

    @property
    def recordings(self) -> Sequence[Recording]:
        """The recordings, newest first."""
        if self._kept is None:
            self._kept = self._found()
        return self._kept

    def path(self, recording: Recording) -> Path:
        """Return the path of a recording's file."""
        return self._folder / f"{Path(recording.id).name}.mcap"

    def keep(self, recording: Recording, write: Callable[[IO[bytes]], int], *, most: int, most_bytes: int) -> Recording:
        """Write a recording with ``write``, which returns the number of messages, and remove the oldest recordings beyond ``most`` and
        ``most_bytes``. Slow: call it in a thread.

        Raises OSError, and TooBig if the recording alone is larger than ``most_bytes``. Earlier recordings then stay.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self.path(recording)
        with replaced_file(path) as file:
            hashing = _Hashing(file)
            messages = write(hashing)  # type: ignore[arg-type]  # it is written to, and asked where that is
            size = file.tell()
            if size > most_bytes:
                raise TooBig(f"it has {size} bytes, and blackBox.maxSize is {most_bytes}")
            figures = {"messages": messages, "size": size, "sha256": hashing.digest}
            described = recording.model_copy(update=figures)
            replace_file(path.with_suffix(".json"), described.model_dump_json())
        self._kept = kept = [described, *(one for one in self.recordings if one.id != described.id)]
        while len(kept) > most or sum(one.size for one in kept) > most_bytes:
            self._remove(self.path(kept[-1]))
            self._kept = kept = kept[:-1]
        return described

    def _remove(self, path: Path) -> None:
        for each in (path, path.with_suffix(".json")):
            each.unlink(missing_ok=True)

    def _found(self) -> list[Recording]:
        """Return the recordings of earlier monitors, and remove incomplete ones."""
        kept: list[Recording] = []
        try:
            for path in self._folder.glob(f"*{NEW}"):
                path.unlink(missing_ok=True)
            for path in self._folder.glob("*.json"):
                if (found := self._read(path)) is not None:
                    kept.append(found)
                else:
                    self._remove(path.with_suffix(".mcap"))
        except OSError as error:
            _logger.warning("recordings in %s: %s", self._folder, error)
        return sorted(kept, key=lambda one: one.failed, reverse=True)

    def _read(self, path: Path) -> Recording | None:
        try:
            recording = Recording.model_validate_json(path.read_text())
        except (ValidationError, UnicodeDecodeError):
            return None
        return recording if path.with_suffix(".mcap").exists() else None


class _Hashing:
    """A file that is only appended to, with a checksum of its content."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._hash, self._place = file, hashlib.sha256(), 0

    def write(self, data: bytes) -> int:
        self._hash.update(data)
        self._place += len(data)
        return self._file.write(data)

    def tell(self) -> int:
        return self._place

    def flush(self) -> None:
        self._file.flush()

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()
