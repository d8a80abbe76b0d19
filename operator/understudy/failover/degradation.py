"""The level between healthy and failed, with hysteresis: a workload at the edge doesn't change it again and again.

The paper acts on failures; sub-optimal behaviour above failure level is what its Future Work leaves.
"""

from __future__ import annotations

from typing import Literal

Told = Literal["Starting", "Healthy", "Failed"]
"""What the tree of ``spec.degraded`` says; Starting where it can't tell."""


class Lasting:
    """Whether something is so, once it has lasted. Times are seconds by one clock that is never set."""

    def __init__(self, since: float | None = None) -> None:
        """``since`` is given where it is known to have been so since then."""
        self.since = since
        """Since when it has been so; None while it isn't."""
        self._so: float | None = None
        self._not_so: float | None = None

    def note(self, so: bool | None, now: float, *, after: float, clear_after: float) -> bool:
        """Note how it is now, None where that can't be told; whether it counts as being so.

        It does once it has been so for ``after`` seconds without a break, and no longer once it hasn't for ``clear_after`` seconds
        without a break. What can't be told breaks both.
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
    """Whether a workload whose health tree holds is degraded. Times are seconds by one clock that is never set."""

    def __init__(self, since: float | None = None) -> None:
        """``since`` is given where it is known to have been degraded since then."""
        self._degraded = Lasting(since)

    @property
    def since(self) -> float | None:
        """Since when it has been degraded; None while it isn't."""
        return self._degraded.since

    def note(self, told: Told, now: float, *, debounce: float, clear_after: float) -> bool:
        """Note what the tree says now; whether the workload is degraded.

        It becomes so once the tree has failed for ``debounce`` seconds without a break, and is no longer once the tree has held for
        ``clear_after`` seconds without a break. What can't be told breaks both.
        """
        failed = None if told == "Starting" else told == "Failed"
        return self._degraded.note(failed, now, after=debounce, clear_after=clear_after)
