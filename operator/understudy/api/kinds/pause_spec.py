"""When a workload is left alone: somebody works on the robot, or on its application."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import Field

from understudy.api.base import Model, matching

MOMENT_PATTERN = (
    r"^[0-9]{4}-(0[1-9]|1[0-2])-(0[1-9]|[12][0-9]|3[01])T([01][0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9](\.[0-9]{1,6})?"
    r"(Z|[-+]([01][0-9]|2[0-3]):[0-5][0-9])$"
)
MOMENT_MESSAGE = "write a moment as a date, a time and its zone (RFC 3339), such as 2026-11-22T18:00:00Z"

Moment = Annotated[
    str, Field(pattern=MOMENT_PATTERN, max_length=40, json_schema_extra=matching(MOMENT_PATTERN, MOMENT_MESSAGE))
]
"""A moment that a person gives. Not with the schema's format date-time, whose refusal says nothing of what would be right."""


def unix(moment: str) -> float | None:
    """A moment as unix seconds; None where there is no such day."""
    try:
        return datetime.fromisoformat(moment).timestamp()
    except ValueError:
        return None


def in_words(moment: float) -> str:
    """A moment (unix seconds) with its date, as people are told it."""
    return datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


class Pause(Model):
    """Maintenance: the monitor goes on watching and telling, and does nothing by itself."""

    reason: str = Field(min_length=1, max_length=256, description="What is being done, for whoever asks why.")
    owner: str = Field(min_length=1, max_length=128, description="Who does it, and is to be asked.")
    until: Moment | None = Field(
        default=None,
        description="When it ends by itself, such as 2026-11-22T18:00:00Z. Absent: when spec.pause is taken away (understudy resume).",
    )

    @property
    def end(self) -> float | None:
        """When it ends by itself, in unix seconds. None for not at all, also where there is no such day: better than at once."""
        return unix(self.until) if self.until is not None else None

    def in_force(self, now: float) -> bool:
        """Whether the workload is to be left alone at this time (unix seconds)."""
        return self.end is None or now < self.end

    @property
    def words(self) -> str:
        """Who has asked for it, why and for how long."""
        until = f", until {in_words(self.end)}" if self.end is not None else ""
        return f"paused by {self.owner}: {self.reason.rstrip('.')}{until}"
