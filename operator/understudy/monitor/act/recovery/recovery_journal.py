"""Saves the recovery in progress, so that the next container of this monitor finishes it."""

from __future__ import annotations

import contextlib
import logging

from understudy.failover.journal import Journal
from understudy.failover.progress import Progress
from understudy.monitor.crash_points import CrashPoints

_logger = logging.getLogger(__name__)


class RecoveryJournal:
    """The journal for the steps of a recovery. An error of the volume does not stop the recovery."""

    def __init__(self, journal: Journal, crash_points: CrashPoints) -> None:
        self.journal, self.crash_points = journal, crash_points

    def save(self, progress: Progress) -> None:
        """Save a step of a recovery."""
        self.crash_points.step("before save")
        try:
            self.journal.save(progress)
        except OSError as error:
            # The next container then continues from the record at the gate, which is newer than the steps that were saved
            # before. Those are therefore removed.
            _logger.error("storing recovery %s failed: %s", progress.id, error)
            self.forget()

    def forget(self) -> None:
        """Remove the saved recovery, so that no monitor continues it."""
        with contextlib.suppress(OSError):
            self.journal.clear()
