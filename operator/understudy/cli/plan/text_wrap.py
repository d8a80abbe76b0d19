"""Has what is printed fit a terminal."""

from __future__ import annotations

import re
import textwrap

_LABEL = re.compile(r"\S+(?: \S+)?\s{2,}")
_LONGEST = 12
"""Characters of a label with the blanks behind it; what is longer is a cell of a table."""


def fitted(text: str, columns: int | None) -> str:
    """A text in lines of at most so many characters, the rest of what stands behind a label below it. As it is where there is no width.

    Rows of a table that begin with no label stay as they are: broken, they would be no table.
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
    # What can't be broken stays in one piece, to be copied.
    return textwrap.wrap(line, width, subsequent_indent=" " * hanging, break_long_words=False, break_on_hyphens=False)
