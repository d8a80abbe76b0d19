"""Times as clocks show them."""

from __future__ import annotations

from datetime import UTC, datetime


def wall(moment: float, *, zone: bool = True) -> str:
    """A time (Unix seconds) as a clock shows it, in UTC, with milliseconds."""
    told = datetime.fromtimestamp(round(moment, 3), UTC).isoformat(sep="T" if zone else " ", timespec="milliseconds")
    return told.replace("+00:00", "Z" if zone else "")
