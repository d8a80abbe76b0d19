"""What is written to: a terminal, of which the whole screen may be written anew, or a file or a pipe."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from typing import TextIO

BEGIN, END = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""Take the terminal's other screen without a cursor, and give both back."""


def colours(out: TextIO) -> bool:
    """Whether to write in colours: only to a terminal, and not where NO_COLOR asks for none (https://no-color.org)."""
    return out.isatty() and not os.environ.get("NO_COLOR")


def columns(out: TextIO) -> int | None:
    """How many characters a line has room for; None where it may be as long as it likes. COLUMNS says it in either case."""
    if not out.isatty() and not os.environ.get("COLUMNS", "").isdigit():
        return None
    return size()[0]


def size() -> tuple[int, int]:
    """The terminal's columns and rows."""
    return shutil.get_terminal_size()


def rows() -> int:
    """How many lines :func:`draw` has room for."""
    return size()[1] - 2


@contextlib.contextmanager
def screen(out: TextIO) -> Iterator[None]:
    """Have the terminal's other screen while the context lasts."""
    out.write(BEGIN)
    try:
        yield
    finally:
        with contextlib.suppress(BrokenPipeError):
            out.write(END)
            out.flush()


def draw(out: TextIO, told: Sequence[str]) -> None:
    """Write as many of these lines as there is room for. Of one that fills its row the last character is lost."""
    # Lines that are too long are cut by the terminal: DECAWM off while they are written.
    body = "".join(f"{line}\x1b[K\r\n" for line in told[: rows()])
    out.write(f"\x1b[?7l\x1b[H{body}\x1b[J\x1b[?7h\r\nCtrl-C ends it. It only watches.\x1b[K")
    out.flush()
