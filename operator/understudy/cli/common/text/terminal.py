"""Writes to a terminal, whose whole screen can be redrawn, or to a file or a pipe."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TextIO, cast

from understudy.api.plain_text import plain
from understudy.cli.common import palette

COLOR = "UNDERSTUDY_COLOR"
"""Environment variable with auto, always or never: what the option ``--color`` sets."""

BEGIN, END = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""Switch to the alternate screen and hide the cursor; and the reverse."""

_LINES, _COLOURS = (
    r"\r?\n|\t",
    rf"\x1b\[(?:0|{'|'.join((palette.TERMINAL_FAINT, *dict.fromkeys(palette.TERMINAL.values())))})m",
)
"""The control characters that are printed: those of lines and, in a terminal, the colours of the palette."""
_IN_FILES, _IN_TERMINALS, _IN_ROWS = (re.compile(f"({kept})") for kept in (_LINES, f"{_LINES}|{_COLOURS}", _COLOURS))


class _Guarded:
    """A stream that escapes control characters, because texts of others would control the terminal with them."""

    def __init__(self, out: TextIO) -> None:
        self.out = out
        self._kept = _IN_TERMINALS if colours(out) else _IN_FILES

    def write(self, text: str) -> int:
        """Write a text with all control characters escaped, except those of lines and colours."""
        self.out.write(_escaped(text, self._kept))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts in the same way."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.out, name)


def _escaped(text: str, kept: re.Pattern[str]) -> str:
    parts = kept.split(text)
    return "".join(part if index % 2 else plain(part) for index, part in enumerate(parts))


def _raw(out: TextIO) -> TextIO:
    return out.out if isinstance(out, _Guarded) else out


@contextlib.contextmanager
def guarded(out: TextIO) -> Iterator[TextIO]:
    """Yield a stream that writes to another one and escapes control characters. Only functions of this module write others."""
    yield cast(TextIO, _Guarded(_raw(out)))


@contextlib.contextmanager
def guarded_output() -> Iterator[None]:
    """Escape control characters in everything that is printed in the context."""
    before = sys.stdout, sys.stderr
    try:
        with guarded(sys.stdout) as sys.stdout, guarded(sys.stderr) as sys.stderr:
            yield
    finally:
        sys.stdout, sys.stderr = before


def colours(out: TextIO) -> bool:
    """Return whether to use colours. By default only in a terminal that can show them, and not if NO_COLOR is set (https://no-color.org)."""
    asked = os.environ.get(COLOR)
    if asked in ("always", "never"):
        return asked == "always"
    return redraws(out) and not os.environ.get("NO_COLOR")


def redraws(out: TextIO) -> bool:
    """Return whether the screen can be redrawn: it is a terminal, and not one without control sequences."""
    return out.isatty() and os.environ.get("TERM") != "dumb"


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
    if isinstance(out := _raw(sys.stdout), io.TextIOWrapper):
        out.reconfigure(errors="backslashreplace")
    try:
        for line in lines:
            print(line)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def screen(out: TextIO) -> Iterator[None]:
    """Use the alternate screen of the terminal for the duration of the context."""
    begin(out)
    try:
        yield
    finally:
        with contextlib.suppress(BrokenPipeError):
            end(out)


def begin(out: TextIO) -> None:
    """Switch to the alternate screen."""
    _raw(out).write(BEGIN)


def end(out: TextIO) -> None:
    """Switch back from the alternate screen."""
    _raw(out).write(END)
    out.flush()


def replace_line(out: TextIO, text: str) -> None:
    """Write a text in place of the current line of a terminal."""
    _raw(out).write(f"\r\x1b[K{plain(text)}")
    out.flush()


READ_ONLY = "Press Ctrl-C to exit. This view is read-only."


def draw(out: TextIO, screen: Sequence[str], foot: str = READ_ONLY) -> None:
    """Write as many of these lines as fit, and one at the foot. A line that fills its row loses its last character."""
    # DECAWM is off meanwhile, so that the terminal cuts long lines.
    body = "".join(f"{_escaped(line, _IN_ROWS)}\x1b[K\r\n" for line in screen[: rows()])
    _raw(out).write(f"\x1b[?7l\x1b[H{body}\x1b[J\x1b[?7h\r\n{foot}\x1b[K")
    out.flush()
