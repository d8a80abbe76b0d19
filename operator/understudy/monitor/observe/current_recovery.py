"""The recovery in progress, if there is one, for tasks that run at the same time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from understudy.failover.progress import Progress


class CurrentRecovery:
    """The recovery in progress of one workload: at most one."""

    def __init__(self) -> None:
        self.progress: Progress | None = None
        self.held: Progress | None = None
        """The same recovery while it is deferred: the failed pod is fenced, and not replaced yet."""

    @contextlib.contextmanager
    def during(self, progress: Progress, *, held: bool = False) -> Iterator[None]:
        """Mark a recovery as in progress."""
        self.progress, self.held = progress, progress if held else None
        try:
            yield
        finally:
            self.progress = self.held = None
