"""Whole numbers in annotations. Whoever may write the object may have written anything there."""

from __future__ import annotations

import re

_DIGITS = re.compile(r"[0-9]{1,18}")


def whole_number(text: str) -> int | None:
    """Return the number that a text of 1 to 18 ASCII digits states; None for any other text."""
    return int(text) if _DIGITS.fullmatch(text) else None
