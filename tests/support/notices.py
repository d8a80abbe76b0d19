"""The notices of a monitor under test, as lists that a test can read."""

from __future__ import annotations

from understudy.monitor.notices import EventRaised, Notice, Notices, PublishedStatus, StatusChanged


class RecordedNotices(Notices):
    """Real notices that record everything that was added, for tests."""

    def __init__(self, status: PublishedStatus | None = None) -> None:
        super().__init__(status)
        self._stream = self.subscribe()
        self._log: list[Notice] = []

    @property
    def log(self) -> list[Notice]:
        """All notices so far."""
        self._log += self._stream.take()
        return self._log

    @property
    def events(self) -> list[tuple[str, str, str]]:
        """Type, reason and message of each Event."""
        return [(one.kind, one.reason, one.message) for one in self.log if isinstance(one, EventRaised)]

    @property
    def reasons(self) -> list[str]:
        """The reason of each Event."""
        return [reason for _, reason, _ in self.events]

    @property
    def conditions(self) -> dict[str, tuple[str, str, str]]:
        """Status, reason and message of each condition, by type."""
        return {c.type: (c.status, c.reason, c.message) for c in self.status.conditions}

    @property
    def changes(self) -> int:
        """How often the status changed."""
        return sum(isinstance(one, StatusChanged) for one in self.log)
