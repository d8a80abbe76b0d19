"""The monitor's own record of the recovery in progress and of abandoned ones, in files that survive a restart of its container."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from understudy.failover.abandoned import AbandonedRecovery
from understudy.failover.progress import Progress
from understudy.process.file_replacement import replace_file

_GIVEN_UP = TypeAdapter(list[AbandonedRecovery])


class Journal:
    """Files that are each replaced atomically. They are not synced: they guard against a killed process, not against a lost node."""

    def __init__(self, path: Path) -> None:
        """``path`` is the file of the present recovery; the file of abandoned recoveries is next to it."""
        self._path, self._given_up = path, path.with_suffix(".given-up")

    def save(self, progress: Progress) -> None:
        """Store the progress of the present recovery."""
        replace_file(self._path, progress.record())

    def load(self) -> Progress | None:
        """Return the stored progress; None if there is none or the file is damaged."""
        try:
            return Progress.of_record(self._path.read_text())
        except (OSError, ValidationError):
            return None

    def clear(self) -> None:
        """Delete the stored progress: the recovery is in the status."""
        self._path.unlink(missing_ok=True)

    def give_up(self, given_up: Sequence[AbandonedRecovery]) -> None:
        """Store exactly these abandoned recoveries. The gate may still report them."""
        if given_up:
            replace_file(self._given_up, _GIVEN_UP.dump_json(list(given_up)).decode())
        else:
            self._given_up.unlink(missing_ok=True)

    def given_up(self) -> list[AbandonedRecovery]:
        """Return the stored abandoned recoveries; empty if the file is damaged."""
        try:
            return _GIVEN_UP.validate_json(self._given_up.read_text())
        except (OSError, ValidationError):
            return []
