"""Tables for terminals of any width."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from understudy.api.plain_text import plain
from understudy.cli.common.text.tree_text import coloured

_GAP = 2


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    state: str = ""
    """The state whose colour it has; empty for none."""
    right: bool = False
    """Whether the text is aligned to the right, as figures are."""

    def format(self, width: int, *, colours: bool) -> str:
        """Return the text padded to a width and coloured."""
        text = plain(self.text)
        padded = text.rjust(width) if self.right else text.ljust(width)
        return coloured(padded, self.state, colours=colours and bool(self.state))


Rows = Sequence[Sequence[Cell]]
"""A table; the first row is the header."""


def width(rows: Rows) -> int:
    """Return the width of a table in characters."""
    return sum(_widths(rows)) + _GAP * (len(rows[0]) - 1)


def format_table(rows: Rows, *, colours: bool = False) -> list[str]:
    """Return the lines of a table with aligned columns."""
    widths = _widths(rows)
    return [
        (" " * _GAP).join(cell.format(w, colours=colours) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def format_texts(rows: Iterable[Sequence[str]], *, right: Collection[int] = ()) -> list[str]:
    """Return the lines of a table of plain texts; the columns ``right`` are aligned to the right."""
    return format_table([[Cell(text, right=column in right) for column, text in enumerate(row)] for row in rows])


def _widths(rows: Rows) -> list[int]:
    return [max(len(plain(row[index].text)) for row in rows) for index in range(len(rows[0]))]
