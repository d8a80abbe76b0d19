"""Debounces failures: a failed tree counts only after it has been failed for a time without interruption."""

from __future__ import annotations


class Debounce:
    """Records since when a tree has been failed. Times are Unix seconds."""

    def __init__(self) -> None:
        self.failing_since: float | None = None
        """When the failure was first seen; None while the tree is not failed."""

    def failed(self, now: float, length: float) -> float:
        """Note that the tree is failed now, and return when that counts, with a debounce of ``length`` seconds."""
        if self.failing_since is None or self.failing_since > now:  # the clock was set back meanwhile
            self.failing_since = now
        return self.failing_since + length

    def clear(self) -> None:
        """Note that the tree is not failed, or that another instance is judged."""
        self.failing_since = None
