"""Recordings of a terminal as asciicast v2, which players of others show too: https://docs.asciinema.org/manual/asciicast/v2/."""

from __future__ import annotations

import json
from dataclasses import dataclass

from understudy_demo.recording.screen import Row, Screen

APART = 0.05
"""Seconds for which a frame stands at least: what is written within them comes in one."""


@dataclass(frozen=True)
class Cast:
    """What a terminal was written, and when."""

    columns: int
    rows: int
    taken: int
    """Unix seconds."""
    title: str
    written: tuple[tuple[float, str], ...]
    """Seconds since its beginning, and what was written then."""

    @property
    def length(self) -> float:
        """Seconds until its last change."""
        return self.written[-1][0]


@dataclass(frozen=True)
class Frame:
    """What the terminal showed from a moment on."""

    time: float
    rows: list[Row]


def to_text(cast: Cast) -> str:
    """The file."""
    head = {
        "version": 2, "width": cast.columns, "height": cast.rows, "timestamp": cast.taken, "title": cast.title,
        "env": {"TERM": "xterm-256color"},
    }  # fmt: skip
    lines = [head, *([round(time, 6), "o", text] for time, text in cast.written)]
    return "".join(f"{json.dumps(line, ensure_ascii=False)}\n" for line in lines)


def from_text(text: str) -> Cast:
    """Of a file."""
    head, *events = map(json.loads, text.splitlines())
    if head["version"] != 2:
        raise ValueError(f"this is asciicast v{head['version']}, not v2")
    written = tuple((time, data) for time, kind, data in events if kind == "o")
    return Cast(head["width"], head["height"], head["timestamp"], head["title"], written)


def frames(cast: Cast) -> list[Frame]:
    """What it showed, from when on; as often as it was another."""
    screen = Screen(cast.columns, cast.rows)
    found: list[Frame] = []
    for time, text in cast.written:
        screen.feed(text)
        rows = screen.rows()
        if found and time - found[-1].time < APART:
            found[-1] = Frame(found[-1].time, rows)
        elif not found or rows != found[-1].rows:
            found.append(Frame(time, rows))
    return found
