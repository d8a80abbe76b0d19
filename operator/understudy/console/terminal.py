"""A screen of a terminal that is written anew, again and again."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from typing import TextIO

BEGIN, END = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""Take the terminal's other screen without a cursor, and give both back."""


def draw(out: TextIO, told: Sequence[str]) -> None:
    """Write as many of these lines as there is room for."""
    rows = shutil.get_terminal_size().lines
    # Lines that are too long are cut by the terminal: DECAWM off while they are written.
    body = "".join(f"{line}\x1b[K\r\n" for line in told[: rows - 2])
    out.write(f"\x1b[?7l\x1b[H{body}\x1b[J\x1b[?7h\r\nCtrl-C ends it. It only watches.\x1b[K")
    out.flush()
