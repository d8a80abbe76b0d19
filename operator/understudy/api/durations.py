"""Durations, and the maximum length of a tree's text. Does not import pydantic, because agents use it."""

from __future__ import annotations

import re

DURATION_PATTERN = r"^([0-9]+(\.[0-9]+)?(ms|s|m|h))+$"
DURATION_MESSAGE = "write a duration as a number with ms, s, m or h, such as 500ms, 1.5s or 1m30s"
_DURATION_PART = re.compile(r"([0-9]+(?:\.[0-9]+)?)(ms|s|m|h)")
_UNIT_SECONDS = {"ms": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0}

LONGEST_TEXT = 65536
"""Maximum length of a tree's text in characters: several hundred nodes with an editor's additions, far below the limit of etcd."""


def seconds(duration: str) -> float:
    """Return the length of a duration such as ``1m30s`` in seconds.

    Raises ValueError if the text is not a duration.
    """
    if not re.fullmatch(DURATION_PATTERN, duration):
        shown = duration if len(duration) <= 60 else f"{duration[:57]}..."
        raise ValueError(f"{shown!r} is not a duration: write a number with ms, s, m or h, such as 500ms or 1m30s")
    return sum(float(number) * _UNIT_SECONDS[unit] for number, unit in _DURATION_PART.findall(duration))
