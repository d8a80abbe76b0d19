"""The level between healthy and failed, with hysteresis, so that a workload at the edge does not change it repeatedly.

The paper acts on failures, and leaves sub-optimal behaviour above failure level to future work.
"""

from __future__ import annotations

from typing import Literal

TreeState = Literal["Starting", "Healthy", "Failed"]
"""The state of the tree of ``spec.degraded``; Starting if it is unknown."""


class Period:
    """Whether something holds and has lasted. Times are seconds of a monotonic clock."""

    def __init__(self, since: float | None = None) -> None:
        """``since`` is when it began to hold, if that is known."""
        self.since = since
        """Since when it holds; None while it does not."""
        self._so: float | None = None
        self._not_so: float | None = None

    def note(self, so: bool | None, now: float, *, after: float, clear_after: float) -> bool:
        """Record whether it holds now (None if that is unknown), and return whether it counts as holding.

        The condition counts after it has held for ``after`` seconds without a break, until it has not held for ``clear_after`` seconds
        without a break. An unknown observation breaks both.
        """
        self._so = (now if self._so is None else self._so) if so else None
        self._not_so = (now if self._not_so is None else self._not_so) if so is False else None
        if self.since is None:
            if self._so is not None and now - self._so >= after:
                self.since = self._so
        elif self._not_so is not None and now - self._not_so >= clear_after:
            self.since = None
        return self.since is not None


class Level:
    """Whether a workload whose health tree holds is degraded. Times are seconds of a monotonic clock."""

    def __init__(self, since: float | None = None) -> None:
        """``since`` is when it became degraded, if that is known."""
        self._degraded = Period(since)

    @property
    def since(self) -> float | None:
        """Since when it is degraded; None while it is not."""
        return self._degraded.since

    def note(self, state: TreeState, now: float, *, debounce: float, clear_after: float) -> bool:
        """Record the state of the tree now, and return whether the workload is degraded.

        It becomes degraded after the tree has failed for ``debounce`` seconds without a break, until the tree has held for ``clear_after``
        seconds without a break. An unknown state breaks both.
        """
        failed = None if state == "Starting" else state == "Failed"
        return self._degraded.note(failed, now, after=debounce, clear_after=clear_after)
