"""Moments: dates with a time and a time zone (RFC 3339), as users and Kubernetes write them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from pydantic import Field

from understudy.api.base import matching

MOMENT_PATTERN = (
    r"^[0-9]{4}-(0[1-9]|1[0-2])-(0[1-9]|[12][0-9]|3[01])T([01][0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9](\.[0-9]{1,6})?"
    r"(Z|[-+]([01][0-9]|2[0-3]):[0-5][0-9])$"
)
MOMENT_MESSAGE = "write a date, a time and a time zone (RFC 3339), such as 2026-11-22T18:00:00Z"

Moment = Annotated[str, matching(MOMENT_PATTERN, MOMENT_MESSAGE, max_length=40)]
"""A moment that a user writes. It does not use the schema's format date-time, whose error message does not say what is expected."""

UnixTime = Annotated[float, Field(ge=-60_000_000_000, le=250_000_000_000, allow_inf_nan=False)]
"""Unix seconds in a record that others may have written: a number that can be converted to a date."""


def unix(moment: str | None) -> float | None:
    """Return a moment as unix seconds, or None if there is none or the date does not exist."""
    try:
        return datetime.fromisoformat(moment or "").timestamp()
    except ValueError:
        return None


def in_words(moment: float) -> str:
    """Return a moment (unix seconds) as text with its date, for users."""
    return datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
