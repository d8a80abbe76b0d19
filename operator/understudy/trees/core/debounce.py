"""Debounces failures: a failed tree counts only after it has been failed for a while without a break."""

from __future__ import annotations


class Debounce:
    """Records since when a tree has been failed. Times are Unix seconds."""

    def __init__(self) -> None:
        self.failing_since: float | None = None
        """When it was seen to be failed first; None while it is not."""

    def failed(self, now: float, length: float) -> float:
        """Note that it is failed now; the moment from which on that counts, with a debounce of ``length`` seconds."""
        if self.failing_since is None or self.failing_since > now:  # the clock was set back since
            self.failing_since = now
        return self.failing_since + length

    def clear(self) -> None:
        """Note that it is not failed, or that another instance is judged."""
        self.failing_since = None
