"""Times and sentences as a person reads them in a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from datetime import UTC, datetime

from understudy.cli.common.tree_text import plain

_UNITS = ((86400, "d"), (3600, "h"), (60, "m"), (1, "s"))


def unix(moment: str) -> float:
    """An RFC 3339 moment as unix seconds."""
    return datetime.fromisoformat(moment).timestamp()


def age(moment: str, now: float) -> str:
    """How long ago a moment was, in its two largest units as kubectl writes it: 12s, 4m12s, 2d3h."""
    left = max(0, int(now - unix(moment)))
    told: list[str] = []
    for size, unit in _UNITS:
        count, left = divmod(left, size)
        if count or told:
            told.append(f"{count}{unit}" if count else "")
    return "".join(told[:2]) or "0s"


def clock(moment: str | float) -> str:
    """A moment (RFC 3339, or unix seconds) as a date and a time in UTC, as the cluster's logs have it."""
    return datetime.fromtimestamp(unix(moment) if isinstance(moment, str) else moment, UTC).strftime(
        "%Y-%m-%d %H:%M:%SZ"
    )


def wrapped(text: str, columns: int | None, *, indent: int, hanging: int | None = None) -> list[str]:
    """A text of others (:func:`plain`) in lines of so many columns, each indented; the first one by ``indent`` and the
    others by ``hanging``. One line where there is no width.
    """
    first, others = " " * indent, " " * (indent if hanging is None else hanging)
    if columns is None:
        return [f"{first}{plain(text)}"]
    width = max(columns, len(others) + 20)
    # What can't be broken is cut by the terminal: a command that is copied from here must stay in one piece.
    return textwrap.wrap(
        plain(text),
        width,
        initial_indent=first,
        subsequent_indent=others,
        break_long_words=False,
        break_on_hyphens=False,
    )


def counted(number: int, one: str, many: str = "") -> str:
    """A number of things, in the singular where it is one."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"


def listed(parts: Iterable[str]) -> str:
    """Parts of a sentence with commas, without the empty ones."""
    return ", ".join(part for part in parts if part)
