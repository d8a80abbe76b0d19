"""The commands that reach a robot, each a mark as it comes, and who takes over when: reads the robot's log from standard input."""

from __future__ import annotations

import shutil
import sys

from understudy.cli.common.text.time_bars import length, short
from understudy_demo.robotview import Command, parse

_COLOURS = (36, 35, 33)
"""Of the pods, in the order in which they drive."""


class Marks:
    """Draws them, from the commands in the order of reception."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._last: Command | None = None
        self._pods = 0
        self._drawn = 0

    def take(self, command: Command) -> str:
        """What to write for one more."""
        last, self._last = self._last, command
        names = short([one.source for one in (command, last) if one])
        name, told = names[command.source], ""
        if last is None or last.source != command.source:
            self._pods += 1
            if last is not None:
                gap = command.received - last.received
                told = f"\n\x1b[1;{self._colour}m{name} drives, {length(gap)} after the last command of {names[last.source]}\x1b[0m"
            self._drawn = 0
        head = f"{name} "
        if self._drawn == 0 or len(head) + self._drawn == self._columns:
            told += "\n" if last else ""
            told += f"\x1b[{self._colour}m{head}\x1b[0m"
            self._drawn = 0
        self._drawn += 1
        return f"{told}\x1b[{self._colour}m|\x1b[0m"

    @property
    def _colour(self) -> int:
        return _COLOURS[(self._pods - 1) % len(_COLOURS)]


def main() -> None:
    """Draw what comes, until it ends."""
    marks = Marks(shutil.get_terminal_size().columns)
    for line in sys.stdin:
        for command in parse([line]).commands:
            print(marks.take(command), end="", flush=True)


if __name__ == "__main__":
    main()
