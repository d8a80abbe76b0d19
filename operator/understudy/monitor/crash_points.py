"""Crash points: let a test kill the monitor at a chosen step of a recovery.

A file ``crash-after`` in the state directory contains a number of steps. At the step after them, the monitor removes the
file, so that the next monitor continues, and kills itself. Without the file, a step costs one failed ``open``.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

_logger = logging.getLogger(__name__)


class CrashPoints:
    """Counts the steps of recoveries while a test asks for it."""

    def __init__(self, state: Path) -> None:
        self._file = state / "crash-after"

    def step(self, name: str) -> None:
        """Count a step of a recovery that is about to be taken or was just taken, and exit if the test asked for it."""
        try:
            left = int(self._file.read_text() or 0)
        except (OSError, ValueError):
            return
        if left > 0:
            self._file.write_text(str(left - 1))
            return
        self._file.unlink()
        _logger.critical("the test file %s makes this process kill itself at step %r", self._file, name)
        os._exit(137)  # as after SIGKILL, which the first process of a container cannot send to itself
