"""The recovery under way, if there is one: what others do meanwhile goes by it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from understudy.failover.progress import Progress


class UnderWay:
    """At most one recovery of one workload."""

    def __init__(self) -> None:
        self.progress: Progress | None = None
        self.held: Progress | None = None
        """The same where what failed is fenced, and nothing else is done about it yet."""

    @contextlib.contextmanager
    def during(self, progress: Progress, *, held: bool = False) -> Iterator[None]:
        """This one is under way."""
        self.progress, self.held = progress, progress if held else None
        try:
            yield
        finally:
            self.progress = self.held = None
