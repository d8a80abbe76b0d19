"""The recording of a failover: what a terminal shows, when it did, and the picture of it."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as some
from understudy_demo.recording import asciicast
from understudy_demo.recording.__main__ import CAST, COLUMNS, LONGEST, PANES, SHELL, STATUS, SVG, act
from understudy_demo.recording.asciicast import Cast, frames
from understudy_demo.recording.marks import Marks
from understudy_demo.recording.panes import NotShown, Pane, Split
from understudy_demo.recording.screen import PLAIN, Row, Screen, Style, sequences
from understudy_demo.recording.svg import HOLD, render
from understudy_demo.robotview import Command

from tests.support.golden import assert_golden

REPOSITORY = Path(__file__).parents[3]
NAMESPACE = "{http://www.w3.org/2000/svg}"

STYLES = some.builds(
    Style, some.none() | some.integers(min_value=0, max_value=7), some.booleans(), some.booleans(), some.booleans()
)
ROWS = some.lists(some.tuples(some.sampled_from("ab █…→"), STYLES), min_size=7, max_size=7)


def shown(*written: str, columns: int = 5, rows: int = 3) -> list[str]:
    """The lines of a terminal after all of this."""
    screen = Screen(columns, rows)
    for text in written:
        screen.feed(text)
    return screen.text().split("\n")


def cast(*written: tuple[float, str], columns: int = 10, rows: int = 2) -> Cast:
    return Cast(columns, rows, 1763820000, "<A> & B", written)


def visible(svg: str, at: float) -> list[str]:
    """The texts that a browser would show so many seconds after the beginning, by its style sheet."""
    length = float(re.findall(r"animation:([\d.]+)s step-end infinite", svg)[0])
    steps = {
        name: [
            (float(moment) / 100 * length, how)
            for moment, how in re.findall(r"([\d.]+)%\{visibility:(\w+)}", keyframes)
        ]
        for name, keyframes in re.findall(r"@keyframes (\w+)\{(.*)}$", svg, re.MULTILINE)
    }
    found = []
    for group in ElementTree.fromstring(svg).iter(f"{NAMESPACE}g"):
        animated = re.fullmatch(r"animation-name:(\w+)", group.get("style", ""))
        if animated is None or [how for begin, how in steps[animated[1]] if begin <= at % length][-1] == "visible":
            found += [text.text or "" for text in group.iter(f"{NAMESPACE}text")]
    return found


def test_text_continues_in_the_next_row_and_scrolls() -> None:
    assert shown("abcdefg\r\nhi") == ["abcde", "fg", "hi"]
    assert shown("abcdefg\r\nhi\r\n\r\nj") == ["hi", "", "j"]
    assert shown("abcde\r\nf") == ["abcde", "f", ""], "a row that is just full is followed by one new one"


def test_the_live_status_is_drawn_as_in_a_terminal() -> None:
    line = "\x1b[?7l\x1b[Habcdefg\x1b[K\r\r\n"
    assert shown("old\r\nold\r\nold", f"{line}\x1b[J") == ["abcd", "", ""], "of a full row the last character is lost"
    assert shown("und", "\x1b[?1049h\x1b[?25l\x1b[H", "over", "\x1b[?25h\x1b[?1049l", "er") == ["under", "", ""]
    assert shown("abc\x1b[2J\x1b[2;3Hx\ty") == ["", "  x y", ""]


def test_a_control_sequence_may_be_split() -> None:
    assert shown("ab\x1b", "[2", ";1", "Hc") == ["ab", "c", ""]


@pytest.mark.parametrize(
    "unknown", ["\x1b[3A", "\x1b[1K", "\x1b[?12h", "\x1b[38;5;1m", "\x1b[9;9H", "\b", "\x1b7", "漢"]
)
def test_an_unknown_control_sequence_is_refused(unknown: str) -> None:
    with pytest.raises(ValueError, match=r"control|SGR|column|isn't one column wide"):
        shown(f"{unknown}x")


@given(ROWS)
def test_a_row_is_unchanged_by_encoding_and_decoding(row: list[tuple[str, Style]]) -> None:
    screen = Screen(len(row), 1)
    screen.feed(f"\x1b[1;1H{sequences(tuple(row))}")
    assert screen.rows() == [tuple(row)]


def test_a_recording_is_unchanged_by_encoding_and_decoding() -> None:
    recorded = cast((0.0, "\x1b[1;1Hé→"), (1.25, "b\r\n"))
    assert asciicast.from_text(asciicast.to_text(recorded)) == recorded
    with pytest.raises(ValueError, match="asciicast v3, not v2"):
        asciicast.from_text('{"version": 3}\n')


def test_each_visible_change_is_a_frame() -> None:
    played = frames(cast((0.0, "a"), (1.0, "b"), (1.01, "c"), (2.0, "\r"), (3.0, "d")))
    assert [(frame.time, text_of(frame.rows[0])) for frame in played] == [(0.0, "a"), (1.0, "abc"), (3.0, "dbc")]


def test_the_picture_shows_each_moment_and_starts_again() -> None:
    svg = render(cast((0.0, "a <b>\r\nstays"), (1.0, "\x1b[1;1H\x1b[K\x1b[32mc  d\x1b[0m"), (2.5, "\x1b[1;1He")))
    end = 2.5 + HOLD
    assert visible(svg, 0.0) == visible(svg, 0.99) == ["a <b>", "stays"]
    assert visible(svg, 1.01) == ["c", "d", "stays"]
    assert visible(svg, 2.51) == visible(svg, end - 0.01) == ["e", "d", "stays"]
    assert visible(svg, end + 0.1) == ["a <b>", "stays"]


def test_characters_are_placed_in_cells_for_any_font() -> None:
    row = "ab   \x1b[1;31mcd\x1b[0m"
    texts = list(ElementTree.fromstring(render(cast((0.0, row)))).iter(f"{NAMESPACE}text"))
    (first, second), width = texts, float(texts[0].attrib["textLength"]) / 2
    assert float(second.attrib["x"]) - float(first.attrib["x"]) == 5 * width
    assert second.attrib["class"] == "c1 b"


def test_bars_are_drawn_as_rectangles_of_their_length() -> None:
    svg = ElementTree.fromstring(render(cast((0.0, "a ░██▌ 5 ms"), columns=12)))
    width = float(next(svg.iter(f"{NAMESPACE}text")).attrib["textLength"])
    areas = [area for group in svg.iter(f"{NAMESPACE}g") for area in group.iter(f"{NAMESPACE}rect")]
    assert [float(area.attrib["width"]) / width for area in areas] == [1, 2, 0.5]
    assert float(areas[2].attrib["x"]) == float(areas[1].attrib["x"]) + 2 * width
    assert visible(render(cast((0.0, "a ██ 5 ms"))), 0.0) == ["a", "5 ms"]


def test_with_reduced_motion_the_picture_shows_the_last_frame() -> None:
    svg = render(cast((0.0, "begin"), (1.0, "\rend\x1b[K")))
    hidden = {
        text.text: group.get("class") for group in ElementTree.fromstring(svg).iter(f"{NAMESPACE}g") for text in group
    }
    assert hidden == {"begin": "a h", "end": "a"}
    assert "@media (prefers-reduced-motion:reduce)" in svg
    assert "{.a,.p{animation:none}}" in svg


def test_the_picture_in_the_repository_is_rendered_from_the_recording() -> None:
    recorded = asciicast.from_text(CAST.read_text())
    svg = SVG.read_text()
    assert svg == render(recorded), "scripts/record --render draws it again"
    assert 15 <= recorded.length <= LONGEST
    assert len(svg) < 300_000
    assert "<script" not in svg
    assert "href" not in svg


def test_each_command_is_a_mark_and_each_takeover_a_line() -> None:
    marks = Marks(columns=12)
    lines = [marks.take(command(n / 20, "robot-1-drive-aaaaa")) for n in range(5)]
    lines.append(marks.take(command(0.712, "robot-1-drive-bbbbb")))
    assert_golden(
        "demo",
        shown(*(text.replace("\n", "\r\n") for text in lines), columns=60, rows=4),
        "…-bbbbb drives",
        "512 ms",
        "…-aaaaa",
    )


def test_programs_in_two_panes_are_recorded_with_their_times() -> None:
    panes = (
        Pane("above", ["sh", "-c", f"printf 'hello\\n{'x' * 30}'; sleep 60"], rows=2),
        Pane("below", ["sh", "-c", 'read line; sleep 0.5; printf "got $line"; sleep 60'], rows=2, typed=True),
    )
    with Split(panes, 30, dict(os.environ)) as split:
        split.until(lambda: "x" in split.text(0), within=30)
        split.begin()
        split.type("abc")
        split.until(lambda: "got abc" in split.text(1), within=30)
        recorded = split.cast("two")
    played = frames(recorded)
    assert recorded.written[0][0] < 0.1
    assert [text_of(row) for row in played[0].rows[1:3]] == ["hello", "x" * 30]
    assert text_of(played[0].rows[3]).startswith("── below ──")
    assert [text_of(row) for row in played[-1].rows[4:]] == ["abc", "got abc"]
    assert played[-1].rows[5][7] == (" ", Style(reverse=True)), "the cursor"
    assert played[-1].rows[1][7] == (" ", PLAIN), "and none where nothing is typed"
    typed = next(frame.time for frame in played if text_of(frame.rows[4]) == "abc")
    assert played[-1].time - typed > 0.5


def test_a_program_that_ends_early_is_reported_with_its_output() -> None:
    with (
        Split((Pane("short", ["sh", "-c", "echo no such robot"], rows=2),), 30, dict(os.environ)) as split,
        pytest.raises(NotShown, match=r"has ended\. It showed:\nno such robot"),
    ):
        split.wait(30)


STAND_IN = """#!{python}
import json, pathlib, sys, time
state = pathlib.Path({state!r})
def pods(): return state.read_text().split()
match sys.argv[1:]:
    case ["status", "-w"]:
        while True:
            found = pods()
            print(f"\\x1b[H1 robot: all protected; 1 healthy …{{found[-1][-6:]}}\\x1b[K", end="", flush=True)
            time.sleep(0.1)
    case ["logs", *_]:
        while True:
            now = time.time()
            told = dict.fromkeys(["sequence", "sent", "linear", "angular", "x", "y", "heading", "speed"], 0)
            print(json.dumps({{"event": "command", "received": now, "source": pods()[-1], **told}}), flush=True)
            time.sleep(0.05)
    case ["inject", "robot-1-drive", *how, "--yes"]:
        with state.open("a") as file:
            file.write(f" robot-1-drive-{{how[0]:b<5.5}}")
    case ["timeline", "robot-1-drive", "--last", "1"]:
        print("    moments   detected +503 ms")
"""


class Hasty(Split):
    """Nobody looks at it."""

    def wait(self, seconds: float) -> None:
        super().wait(seconds / 20)


def test_the_script_of_the_recording_follows_what_is_shown(tmp_path: Path) -> None:
    """Its commands are stand-ins, but for the marks."""
    state = tmp_path / "state"
    state.write_text("robot-1-drive-aaaaa")
    for name in ("understudy", "kubectl"):
        (tmp_path / name).write_text(STAND_IN.format(python=sys.executable, state=str(state)))
        (tmp_path / name).chmod(0o755)
    (tmp_path / "marks").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m understudy_demo.recording.marks\n')
    (tmp_path / "marks").chmod(0o755)
    environment = {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "PYTHONPATH": f"{REPOSITORY / 'operator'}:{REPOSITORY / 'demo'}",
        "PS1": "$ ",
    }
    with Hasty(PANES, COLUMNS, environment) as split:
        act(split)
        recorded = split.cast("rehearsal")
        assert "freez" in split.text(STATUS)
        assert "moments" in split.text(SHELL)
    last = "\n".join(text_of(row) for row in frames(recorded)[-1].rows)
    assert re.search(r"…-freez drives, \d+ ms after the last command of …-killb", last)
    assert "$ understudy inject robot-1-drive kill --yes" in last


def command(received: float, source: str) -> Command:
    return Command(received, source, 0, received, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5)


def text_of(row: Row) -> str:
    return "".join(character for character, _ in row).rstrip()
