"""Formats times, counts and paragraphs for a terminal."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from datetime import UTC, datetime

from understudy.api.plain_text import plain

_LABEL = re.compile(r"\S+(?: \S+)?\s{2,}")
_LONGEST = 12
"""Most characters of a label with the blanks after it; longer ones are table cells."""

_UNITS = ((86400, "d"), (3600, "h"), (60, "m"), (1, "s"))


def unix(moment: str) -> float:
    """Parse an RFC 3339 time into unix seconds."""
    return datetime.fromisoformat(moment).timestamp()


def moment(text: str) -> float:
    """Parse a date or a time (ISO 8601, in UTC if it has no time zone) into unix seconds. Raises ValueError."""
    found = datetime.fromisoformat(text)
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def age(moment: str, now: float) -> str:
    """Return how long ago a time was, in its two largest units as kubectl writes it: 12s, 4m12s, 2d3h."""
    left = max(0, int(now - unix(moment)))
    parts: list[str] = []
    for size, unit in _UNITS:
        count, left = divmod(left, size)
        if count or parts:
            parts.append(f"{count}{unit}" if count else "")
    return "".join(parts[:2]) or "0s"


def clock(moment: str | float) -> str:
    """Format a time (RFC 3339, or unix seconds) as date and time in UTC, as in the cluster's logs."""
    return datetime.fromtimestamp(unix(moment) if isinstance(moment, str) else moment, UTC).strftime(
        "%Y-%m-%d %H:%M:%SZ"
    )


def wall(moment: float, *, zone: bool = True) -> str:
    """Format a time (unix seconds) in UTC with milliseconds."""
    text = datetime.fromtimestamp(round(moment, 3), UTC).isoformat(sep="T" if zone else " ", timespec="milliseconds")
    return text.replace("+00:00", "Z" if zone else "")


def wrapped(text: str, columns: int | None, *, indent: int, hanging: int | None = None) -> list[str]:
    """Wrap an untrusted text (:func:`plain`) to a width; ``indent`` is for the first line and ``hanging`` for the others.

    Returns one line if ``columns`` is None.
    """
    first, others = " " * indent, " " * (indent if hanging is None else hanging)
    if columns is None:
        return [f"{first}{plain(text)}"]
    width = max(columns, len(others) + 20)
    # Long words are cut by the terminal rather than broken: a command that is copied from here must stay in one piece.
    return textwrap.wrap(
        plain(text),
        width,
        initial_indent=first,
        subsequent_indent=others,
        break_long_words=False,
        break_on_hyphens=False,
    )


def counted(number: int, one: str, many: str = "") -> str:
    """Format a number of things, in singular or plural."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"


def listed(parts: Iterable[str]) -> str:
    """Join the parts that are not empty with commas."""
    return ", ".join(part for part in parts if part)


def wrap_labelled(text: str, columns: int | None) -> str:
    """Wrap a text, and indent the lines after a label to the text of the label. Returns it unchanged if there is no width.

    Table rows without a label stay unchanged.
    """
    if columns is None:
        return text
    return "\n".join("\n".join(_broken(line, columns)) for line in text.split("\n"))


def _broken(line: str, columns: int) -> list[str]:
    label = _LABEL.match(line)
    hanging = len(label[0]) if label and len(label[0]) <= _LONGEST else 0
    if not label and "  " not in line.strip():
        hanging = len(line) - len(line.lstrip())
    if len(line) <= columns or ("  " in line.strip() and not hanging):
        return [line]
    width = max(columns, hanging + 20)
    # Long words stay in one piece, to be copied.
    return textwrap.wrap(line, width, subsequent_indent=" " * hanging, break_long_words=False, break_on_hyphens=False)
