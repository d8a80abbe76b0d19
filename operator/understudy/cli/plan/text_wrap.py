"""Wraps labelled text to the width of a terminal."""

from __future__ import annotations

import re
import textwrap

_LABEL = re.compile(r"\S+(?: \S+)?\s{2,}")
_LONGEST = 12
"""Most characters of a label with the blanks after it; longer ones are table cells."""


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
