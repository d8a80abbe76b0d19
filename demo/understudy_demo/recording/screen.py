"""What a terminal shows.

It knows what the programs of the recording write, and refuses everything else: a picture that is subtly wrong would be worse than none.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, replace

_PART = re.compile(
    r"\x1b\[(?P<private>\??)(?P<numbers>[\d;]*)(?P<final>[A-Za-z])|(?P<text>[^\x00-\x1f\x7f]+)|(?P<control>.)",
    re.DOTALL,
)
_UNFINISHED = re.compile(r"\x1b(\[[?\d;]*)?\Z")

_TAB = 8


@dataclass(frozen=True, slots=True)
class Style:
    """How a character looks."""

    colour: int | None = None
    """0 to 7, as in SGR 30 to 37; None for the terminal's own."""
    bold: bool = False
    faint: bool = False
    reverse: bool = False


PLAIN = Style()

Row = tuple[tuple[str, Style], ...]
"""A row's characters."""

_BLANK = (" ", PLAIN)


class Screen:
    """A terminal of a fixed size."""

    def __init__(self, columns: int, rows: int) -> None:
        self.columns = columns
        self._height = rows
        self._style = PLAIN
        self._wraps = True
        self._rest = ""
        self._row = self._column = 0
        self._cells = self._blank()
        self._under = self._cells, self._row, self._column

    def rows(self) -> list[Row]:
        """What it shows."""
        return [tuple(row) for row in self._cells]

    def text(self) -> str:
        """What it shows, without how."""
        return "\n".join("".join(character for character, _ in row).rstrip() for row in self._cells)

    @property
    def cursor(self) -> tuple[int, int]:
        """Its row and column, from 0."""
        return self._row, min(self._column, self.columns - 1)

    def feed(self, text: str) -> None:
        """Take in what a program wrote; it may end in the middle of a sequence. Raises ValueError where it is not known."""
        text = self._rest + text
        unfinished = _UNFINISHED.search(text)
        self._rest = unfinished[0] if unfinished else ""
        for part in _PART.finditer(text.removesuffix(self._rest)):
            if part["text"]:
                for character in part["text"]:
                    self._put(character)
            elif part["control"]:
                self._control(part["control"])
            else:
                numbers = [int(number or 0) for number in part["numbers"].split(";")]
                self._sequence(part["private"] + part["final"], numbers)

    def _put(self, character: str) -> None:
        if unicodedata.east_asian_width(character) in "WF" or unicodedata.combining(character):
            raise ValueError(f"{character!r} is not one column wide")
        if self._column >= self.columns:
            if self._wraps:
                self._column = 0
                self._feed_line()
            else:
                self._column = self.columns - 1
        self._cells[self._row][self._column] = (character, self._style)
        self._column += 1

    def _control(self, character: str) -> None:
        match character:
            case "\r":
                self._column = 0
            case "\n":
                self._feed_line()
            case "\t":
                self._column = min(self._column // _TAB * _TAB + _TAB, self.columns - 1)
            case "\a":
                pass
            case _:
                raise ValueError(f"control character {character!r}")

    def _sequence(self, kind: str, numbers: list[int]) -> None:
        match kind, numbers:
            case "m", _:
                self._style = _styled(self._style, numbers)
            case "H", [0]:
                self._row = self._column = 0
            case "H", [row, column] if row <= self._height and column <= self.columns:
                self._row, self._column = max(row, 1) - 1, max(column, 1) - 1
            case "K", [0]:
                self._erase_line()
            case "J", [0]:
                self._erase_line()
                for row in range(self._row + 1, self._height):
                    self._cells[row] = [_BLANK] * self.columns
            case "J", [2]:
                self._cells = self._blank()
            case (("?h" | "?l"), [7]):
                self._wraps = kind == "?h"
            case "?h", [1049]:
                self._under, self._cells = (self._cells, self._row, self._column), self._blank()
            case "?l", [1049]:
                self._cells, self._row, self._column = self._under
            case (("?h" | "?l"), [25 | 2004]):  # the cursor, which is not drawn by this; pastes that are marked as such
                pass
            case _:
                raise ValueError(f"control sequence {kind!r} with {numbers}")

    def _blank(self) -> list[list[tuple[str, Style]]]:
        return [[_BLANK] * self.columns for _ in range(self._height)]

    def _erase_line(self) -> None:
        column = min(self._column, self.columns - 1)
        self._cells[self._row][column:] = [_BLANK] * (self.columns - column)

    def _feed_line(self) -> None:
        if self._row < self._height - 1:
            self._row += 1
        else:
            self._cells = [*self._cells[1:], [_BLANK] * self.columns]


def _styled(style: Style, numbers: list[int]) -> Style:
    """A style after SGR."""
    for number in numbers:
        match number:
            case 0:
                style = PLAIN
            case 1:
                style = replace(style, bold=True)
            case 2:
                style = replace(style, faint=True)
            case 7:
                style = replace(style, reverse=True)
            case _ if 30 <= number <= 37:
                style = replace(style, colour=number - 30)
            case _:
                raise ValueError(f"SGR {number}")
    return style


def sequences(row: Row) -> str:
    """What has a terminal show a row, but for blanks at its end; it leaves the style plain."""
    last = max((index for index, cell in enumerate(row) if cell != _BLANK), default=-1)
    told, before = "", PLAIN
    for character, style in row[: last + 1]:
        if style != before:
            numbers = [1] * style.bold + [2] * style.faint + [7] * style.reverse
            numbers += [] if style.colour is None else [30 + style.colour]
            told += f"\x1b[{';'.join(map(str, [0, *numbers]))}m"
            before = style
        told += character
    return told if before == PLAIN else f"{told}\x1b[0m"
