"""Maintenance mode: Understudy takes no action while somebody works on the robot or its application."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import Field

from understudy.api.base import Model, matching

MOMENT_PATTERN = (
    r"^[0-9]{4}-(0[1-9]|1[0-2])-(0[1-9]|[12][0-9]|3[01])T([01][0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9](\.[0-9]{1,6})?"
    r"(Z|[-+]([01][0-9]|2[0-3]):[0-5][0-9])$"
)
MOMENT_MESSAGE = "write a date, a time and a time zone (RFC 3339), such as 2026-11-22T18:00:00Z"

Moment = Annotated[str, matching(MOMENT_PATTERN, MOMENT_MESSAGE, max_length=40)]
"""A moment that a user writes. It does not use the schema's format date-time, whose error message does not say what is expected."""


def unix(moment: str | None) -> float | None:
    """Return a moment as unix seconds, or None if there is none or the date does not exist."""
    try:
        return datetime.fromisoformat(moment or "").timestamp()
    except ValueError:
        return None


def in_words(moment: float) -> str:
    """Return a moment (unix seconds) as text with its date, for users."""
    return datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


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
    def words(self) -> str:
        """Who paused the workload, why and until when."""
        until = f", until {in_words(self.end)}" if self.end is not None else ""
        return f"paused by {self.owner}: {self.reason.rstrip('.')}{until}"
