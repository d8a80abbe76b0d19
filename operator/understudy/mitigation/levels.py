"""The level between healthy and failed, with hysteresis: a workload at the edge doesn't change it again and again.

The paper acts on failures; sub-optimal behaviour above failure level is what its Future Work leaves.
"""

from __future__ import annotations

from typing import Literal

Told = Literal["Starting", "Healthy", "Failed"]
"""What the tree of ``spec.degraded`` says; Starting where it can't tell."""


class Level:
    """Whether a workload whose health tree holds is degraded. Times are seconds by one clock that is never set."""

    def __init__(self, since: float | None = None) -> None:
        """``since`` is given where it is known to have been degraded since then."""
        self.since = since
        """Since when it has been degraded; None while it isn't."""
        self._failing: float | None = None
        self._well: float | None = None

    def note(self, told: Told, now: float, *, debounce: float, clear_after: float) -> bool:
        """Note what the tree says now; whether the workload is degraded.

        It becomes so once the tree has failed for ``debounce`` seconds without a break, and is no longer once the tree has held for
        ``clear_after`` seconds without a break. What can't be told breaks both.
        """
        self._failing = (now if self._failing is None else self._failing) if told == "Failed" else None
        self._well = (now if self._well is None else self._well) if told == "Healthy" else None
        if self.since is None:
            if self._failing is not None and now - self._failing >= debounce:
                self.since = self._failing
        elif self._well is not None and now - self._well >= clear_after:
            self.since = None
        return self.since is not None
