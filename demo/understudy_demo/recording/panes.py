"""A terminal that is split: a program in each part, in a pseudo-terminal of its own, and what all of it showed and when."""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import os
import select
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType

from understudy_demo.recording.asciicast import Cast
from understudy_demo.recording.screen import Row, Screen, Style, sequences

_TITLE = Style(colour=4, bold=True)
_RULE = Style(faint=True)
_STROKE = 0.03
"""Seconds between two strokes on the keyboard."""


class NotShown(Exception):
    """Something that was waited for was not shown; the message has what was."""


@dataclass(frozen=True)
class Pane:
    """A part of the terminal."""

    title: str
    command: Sequence[str]
    rows: int
    typed: bool = False
    """Whether it is the one that is typed into, whose cursor is shown."""


class Program:
    """What runs in a pane, and what it shows."""

    def __init__(self, pane: Pane, columns: int, environment: Mapping[str, str]) -> None:
        self.screen = Screen(columns, pane.rows)
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._terminal, inside = os.openpty()
        fcntl.ioctl(inside, termios.TIOCSWINSZ, struct.pack("HHHH", pane.rows, columns, 0, 0))
        self._process = subprocess.Popen(
            pane.command,
            env={**environment, "TERM": "xterm-256color"},
            preexec_fn=lambda: os.login_tty(inside),  # a terminal of its own, which Ctrl-C and the shell's jobs need
        )
        os.close(inside)

    def fileno(self) -> int:
        """For select."""
        return self._terminal

    def read(self) -> None:
        """Take in what it has written. Raises NotShown where it has ended."""
        try:
            data = os.read(self._terminal, 65536)
        except OSError:  # EIO: nobody has the other side open any more
            data = b""
        if not data:
            raise NotShown(f"{self._process.args!r} has ended. It showed:\n{self.screen.text()}")
        self.screen.feed(self._decoder.decode(data))

    def write(self, text: str) -> None:
        """Type into it."""
        os.write(self._terminal, text.encode())

    def close(self) -> None:
        """Hang up, and wait for its end."""
        os.close(self._terminal)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Split:
    """The terminal, from above: for each pane a line with its title, and what its program shows."""

    def __init__(self, panes: Sequence[Pane], columns: int, environment: Mapping[str, str]) -> None:
        self._panes, self._columns = panes, columns
        self._programs = [Program(pane, columns, environment) for pane in panes]
        self._shown: list[Row] = []
        self._written: list[tuple[float, str]] = []
        self._begun: float | None = None
        self._taken = 0

    def __enter__(self) -> Split:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in self._programs:
            with contextlib.suppress(OSError):
                program.close()

    def begin(self) -> None:
        """Record from now on, beginning with what is shown already."""
        self._begun, self._taken = time.monotonic(), int(time.time())
        self._shown = [()] * sum(1 + pane.rows for pane in self._panes)
        self._record("\x1b[?25l")

    def text(self, pane: int) -> str:
        """What is shown in a pane."""
        return self._programs[pane].screen.text()

    def wait(self, seconds: float) -> None:
        """Let it go on for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._look(left)

    def until(self, shown: Callable[[], bool], *, within: float) -> None:
        """Let it go on until something is shown. Raises NotShown."""
        end = time.monotonic() + within
        while not shown():
            if time.monotonic() > end:
                panes = "\n".join(f"--- {pane.title}\n{self.text(index)}" for index, pane in enumerate(self._panes))
                raise NotShown(f"not within {within:g} s. What is shown:\n{panes}")
            self._look(0.1)

    def type(self, text: str) -> None:
        """Type a line as a person does, and Return."""
        program = next(p for pane, p in zip(self._panes, self._programs, strict=True) if pane.typed)
        for character in text:
            program.write(character)
            self.wait(_STROKE)
        self.wait(0.4)
        program.write("\n")

    def cast(self, title: str) -> Cast:
        """What was recorded since :meth:`begin`."""
        return Cast(self._columns, len(self._shown), self._taken, title, tuple(self._written))

    def _look(self, seconds: float) -> None:
        """Take in what is written within a time, until some is."""
        ready, _, _ = select.select(self._programs, [], [], seconds)
        for program in ready:
            program.read()
        if ready and self._begun is not None:
            self._record()

    def _record(self, before: str = "") -> None:
        rows = [
            row for pane, program in zip(self._panes, self._programs, strict=True) for row in self._drawn(pane, program)
        ]
        changed = "".join(
            f"\x1b[{number};1H\x1b[K{sequences(row)}"
            for number, (row, shown) in enumerate(zip(rows, self._shown, strict=True), 1)
            if row != shown
        )
        self._shown = rows
        if changed:
            assert self._begun is not None
            self._written.append((time.monotonic() - self._begun, before + changed))

    def _drawn(self, pane: Pane, program: Program) -> Iterator[Row]:
        rule = "─" * (self._columns - len(pane.title) - 4)
        yield tuple(
            (character, style)
            for text, style in (("── ", _RULE), (pane.title, _TITLE), (f" {rule}", _RULE))
            for character in text
        )
        for number, row in enumerate(program.screen.rows()):
            at, column = program.screen.cursor
            if pane.typed and number == at:
                character, style = row[column]
                row = (*row[:column], (character, replace(style, reverse=True)), *row[column + 1 :])
            yield row
