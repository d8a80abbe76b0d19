"""Formats wall times."""

from __future__ import annotations

from datetime import UTC, datetime


def wall(moment: float, *, zone: bool = True) -> str:
    """Format a time (unix seconds) in UTC with milliseconds."""
    text = datetime.fromtimestamp(round(moment, 3), UTC).isoformat(sep="T" if zone else " ", timespec="milliseconds")
    return text.replace("+00:00", "Z" if zone else "")
