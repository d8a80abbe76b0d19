"""Saves the recovery in progress, so that the next container of this monitor finishes it."""

from __future__ import annotations

import contextlib
import logging

from understudy.failover.journal import Journal
from understudy.failover.progress import Progress
from understudy.monitor.crash_points import CrashPoints

_logger = logging.getLogger(__name__)


class RecoveryJournal:
    """The journal as the steps of a recovery use it: a full volume does not stop a recovery."""

    def __init__(self, journal: Journal, crash_points: CrashPoints) -> None:
        self.journal, self.crash_points = journal, crash_points

    def save(self, progress: Progress) -> None:
        """Save a step of a recovery."""
        self.crash_points.step("before save")
        try:
            self.journal.save(progress)
        except OSError as error:
            # A full volume costs what the next container would know, and never the robot its recovery. The record at the gate
            # is newer than what was saved before, so that is removed.
            _logger.error("storing recovery %s failed: %s", progress.id, error)
            self.forget()

    def forget(self) -> None:
        """Remove what was saved, so that no monitor finishes it."""
        with contextlib.suppress(OSError):
            self.journal.clear()
