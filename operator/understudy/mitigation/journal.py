"""The monitor's own record of a recovery under way, in a file that lasts over a restart of its container."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import ValidationError

from understudy.mitigation.progress import Progress


class Journal:
    """One file, replaced atomically. It isn't synced: it guards against a killed process, not against a lost node."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def save(self, progress: Progress) -> None:
        """Keep the progress of the present recovery."""
        temporary = self._path.with_suffix(".new")
        temporary.write_text(progress.model_dump_json())
        os.replace(temporary, self._path)

    def load(self) -> Progress | None:
        """The last progress kept, or None; a damaged file counts as none."""
        try:
            return Progress.model_validate_json(self._path.read_text())
        except (OSError, ValidationError):
            return None

    def clear(self) -> None:
        """Forget it: the recovery is in the status."""
        self._path.unlink(missing_ok=True)
