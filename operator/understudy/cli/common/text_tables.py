"""Tables for terminals of any width."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from understudy.cli.common.tree_text import coloured, plain

_GAP = 2


class Cell(NamedTuple):
    """What stands in one place."""

    text: str
    state: str = ""
    """By which it is coloured; empty for no colour."""

    def drawn(self, width: int, *, colours: bool) -> str:
        """Padded to a width, in its colour."""
        padded = plain(self.text).ljust(width)
        return coloured(padded, self.state, colours=colours and bool(self.state))


Rows = Sequence[Sequence[Cell]]
"""A table: its first row is the head."""


def width(rows: Rows) -> int:
    """How many columns of a terminal a table takes."""
    return sum(_widths(rows)) + _GAP * (len(rows[0]) - 1)


def drawn(rows: Rows, *, colours: bool) -> list[str]:
    """A table's lines, its columns under each other."""
    widths = _widths(rows)
    return [
        (" " * _GAP).join(cell.drawn(w, colours=colours) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _widths(rows: Rows) -> list[int]:
    return [max(len(plain(row[index].text)) for row in rows) for index in range(len(rows[0]))]
