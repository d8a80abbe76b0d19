"""How long things are: durations as they are written, and a tree's text. Without models, as agents need it."""

from __future__ import annotations

import re

DURATION_PATTERN = r"^([0-9]+(\.[0-9]+)?(ms|s|m|h))+$"
DURATION_MESSAGE = "write a duration as a number with ms, s, m or h, such as 500ms, 1.5s or 1m30s"
_DURATION_PART = re.compile(r"([0-9]+(?:\.[0-9]+)?)(ms|s|m|h)")
_UNIT_SECONDS = {"ms": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0}

LONGEST_TEXT = 65536
"""Characters that a tree may have that is a text: some hundred nodes and what an editor adds, far below what etcd takes."""


def seconds(duration: str) -> float:
    """The length of a duration such as ``1m30s`` in seconds.

    Raises ValueError when it isn't one.
    """
    if not re.fullmatch(DURATION_PATTERN, duration):
        raise ValueError(f"{duration!r} is not a duration: write a number with ms, s, m or h, such as 500ms or 1m30s")
    return sum(float(number) * _UNIT_SECONDS[unit] for number, unit in _DURATION_PART.findall(duration))
