"""Maintenance mode: Understudy takes no action while somebody works on the robot or its application."""

from __future__ import annotations

from pydantic import Field

from understudy.api.base import Model, reported
from understudy.api.moments import Moment, in_words, unix

FENCE = "fenced: "
"""How the reason of a pause begins that belongs to a fence (understudy fence)."""


class Pause(Model):
    """Maintenance mode: the monitor watches and reports, and takes no action."""

    reason: str = Field(min_length=1, max_length=256)
    """Why the workload is paused, for other users."""
    owner: str = Field(min_length=1, max_length=128)
    """Who paused the workload and can be asked about it."""
    until: Moment | None = None
    """When the pause ends, such as 2026-11-22T18:00:00Z. Absent: when a user removes spec.pause (understudy resume)."""

    @property
    def end(self) -> float | None:
        """When the pause ends, in unix seconds. None if it does not end by itself.

        A date that does not exist counts as None too, which is safer than an immediate end.
        """
        return unix(self.until) if self.until is not None else None

    def in_force(self, now: float) -> bool:
        """Return whether the pause is in effect at this time (unix seconds)."""
        return self.end is None or now < self.end

    @property
    def is_fence(self) -> bool:
        """Whether the gate stays closed during this pause."""
        return self.reason.startswith(FENCE)

    @property
    def words(self) -> str:
        """Who paused the workload, why and until when."""
        until = f", until {in_words(self.end)}" if self.end is not None else ""
        return f"paused by {reported(self.owner)}: {reported(self.reason).rstrip('.')}{until}"
