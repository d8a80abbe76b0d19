"""Durations in XML profiles."""

from __future__ import annotations


def seconds_xml(length: float) -> str:
    """Return the elements of a duration of so many seconds."""
    whole, nanoseconds = divmod(round(length * 1e9), 10**9)
    return f"<sec>{whole}</sec><nanosec>{nanoseconds}</nanosec>"
