"""Writes to a terminal, whose whole screen can be redrawn, or to a file or a pipe."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TextIO

BEGIN, END = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""Switch to the alternate screen and hide the cursor; and the reverse."""


def colours(out: TextIO) -> bool:
    """Return whether to use colours: only in a terminal, and not if NO_COLOR is set (https://no-color.org)."""
    return out.isatty() and not os.environ.get("NO_COLOR")


def columns(out: TextIO) -> int | None:
    """Return the width of a line in characters; None if there is no limit. COLUMNS overrides both."""
    if not out.isatty() and not os.environ.get("COLUMNS", "").isdigit():
        return None
    return size()[0]


def size() -> tuple[int, int]:
    """Return the columns and rows of the terminal."""
    return shutil.get_terminal_size()


def rows() -> int:
    """Return how many lines :func:`draw` can show."""
    return size()[1] - 2


def write(lines: Iterable[str]) -> None:
    """Print lines. Characters that the terminal cannot show are escaped, and the reader, such as ``head``, may have exited."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        for line in lines:
            print(line)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def screen(out: TextIO) -> Iterator[None]:
    """Use the alternate screen of the terminal for the duration of the context."""
    out.write(BEGIN)
    try:
        yield
    finally:
        with contextlib.suppress(BrokenPipeError):
            out.write(END)
            out.flush()


def draw(out: TextIO, screen: Sequence[str]) -> None:
    """Write as many of these lines as fit. A line that fills its row loses its last character."""
    # DECAWM is off meanwhile, so that the terminal cuts long lines.
    body = "".join(f"{line}\x1b[K\r\n" for line in screen[: rows()])
    out.write(f"\x1b[?7l\x1b[H{body}\x1b[J\x1b[?7h\r\nPress Ctrl-C to exit. This view is read-only.\x1b[K")
    out.flush()
