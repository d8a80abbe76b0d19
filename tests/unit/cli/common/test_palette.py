"""The colours are decided in one module, and people with each kind of colour vision tell them apart."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from testcluster.paths import REPOSITORY
from understudy.cli.common import palette

PAGE = REPOSITORY / "operator" / "understudy" / "cli" / "report" / "page.css"
TREE = REPOSITORY / "operator" / "understudy" / "monitor" / "report" / "tree.html"
DASHBOARDS = sorted((REPOSITORY / "charts" / "understudy" / "files" / "dashboards").glob("*.json"))

ELSEWHERE = {
    "operator/understudy/cli/common/palette.py",
    "demo/understudy_demo/recording/svg.py",  # the eight colours of a terminal
    "scripts/generation/drawing.py",  # frames of boxes that have names
    "scripts/generation/diagrams.py",  # their backgrounds
}
"""Modules that may have colours of their own."""

Matrix = tuple[tuple[float, float, float], ...]

VISION: dict[str, Matrix] = {
    "usual": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "protanopia": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deuteranopia": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    "tritanopia": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
}
"""What somebody sees of linear red, green and blue: Machado, Oliveira and Fernandes (2009), at full severity."""

XYZ: Matrix = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))
WHITE = (0.9505, 1.0, 1.089)

APART = 15
"""The least difference in CIELAB. The former colours of states came to 5."""

READABLE = 4.5
"""The least contrast of words, by WCAG 2.2 (level AA)."""


def linear(colour: str) -> list[float]:
    """Return linear red, green and blue."""
    parts = (int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]


def product(matrix: Matrix, vector: list[float]) -> list[float]:
    """Return a matrix times a vector."""
    return [sum(a * b for a, b in zip(row, vector, strict=True)) for row in matrix]


def seen(colour: str, vision: str) -> tuple[float, float, float]:
    """Return what somebody sees of a colour, in CIELAB."""
    there = [min(1.0, max(0.0, part)) for part in product(VISION[vision], linear(colour))]
    shares = [part / white for part, white in zip(product(XYZ, there), WHITE, strict=True)]
    x, y, z = (share ** (1 / 3) if share > 0.008856 else 7.787 * share + 16 / 116 for share in shares)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def difference(one: str, other: str, vision: str) -> float:
    """Return how different two colours look."""
    return sum((a - b) ** 2 for a, b in zip(seen(one, vision), seen(other, vision), strict=True)) ** 0.5


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours by WCAG."""
    low, high = sorted(product(XYZ, linear(colour))[1] for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def themes(text: str) -> list[dict[str, str]]:
    """Return the colours of a style sheet, by name: those of the light page and those of the dark one."""
    light, dark, *_ = text.split("@media (prefers-color-scheme: dark)")
    return [dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", one.partition("@media")[0])) for one in (light, dark)]


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize(
    "colours",
    [
        palette.PARTS.values(),
        palette.STATES.values(),
        palette.SERIES,
        palette.ON_LIGHT.values(),
        palette.ON_DARK.values(),
    ],
    ids=["parts", "states", "series", "light page", "dark page"],
)
def test_colours_of_one_picture_look_different(colours: list[str], vision: str) -> None:
    close = [
        (one, other) for one, other in itertools.combinations(colours, 2) if difference(one, other, vision) < APART
    ]
    assert close == []


@pytest.mark.parametrize("page", [PAGE, TREE], ids=["report", "tree"])
def test_words_on_a_page_have_contrast(page: Path) -> None:
    for found, own in zip(themes(page.read_text()), (palette.ON_LIGHT, palette.ON_DARK), strict=True):
        for colour in own.values():
            assert contrast(colour, found["card"]) >= READABLE
            assert contrast(colour, found["back"]) >= READABLE


def test_the_report_has_the_colours_of_the_palette() -> None:
    light, dark = themes(PAGE.read_text())
    assert light.items() >= {**palette.PARTS, **palette.ON_LIGHT, "outage": palette.VERMILLION}.items()
    assert dark.items() >= palette.ON_DARK.items()


def test_the_page_of_the_tree_has_the_colours_of_the_palette() -> None:
    for found, own, start, idle in zip(
        themes(TREE.read_text()),
        (palette.ON_LIGHT, palette.ON_DARK),
        (palette.BLUE, palette.SKY),
        (palette.GREY, palette.RULE),
        strict=True,
    ):
        expected = {
            "Healthy": own["good"],
            "Degraded": own["warn"],
            "Recovering": own["warn"],
            "Failed": own["bad"],
            "Starting": start,
            **dict.fromkeys(("Idle", "Unasked", "Unknown"), idle),
        }
        assert found.items() >= expected.items()


def colours_of(board: object) -> Iterator[tuple[str | None, str]]:
    """Return the colours in a dashboard, each with the text that it is for."""
    if isinstance(board, dict):
        for key in ("color", "fixedColor"):
            if isinstance(board.get(key), str):
                yield board.get("text"), board[key]
    for value in board.values() if isinstance(board, dict) else board if isinstance(board, list) else ():
        yield from colours_of(value)


@pytest.mark.parametrize("board", DASHBOARDS, ids=lambda path: path.stem)
def test_a_dashboard_has_the_colours_of_the_palette(board: Path) -> None:
    found = list(colours_of(json.loads(board.read_text())))
    assert found
    assert {colour for _, colour in found} <= set(palette.STATES.values())
    assert all(palette.STATES[text] == colour for text, colour in found if text in palette.STATES)


def test_no_module_decides_colours_of_its_own() -> None:
    files = [
        file
        for folder in ("operator", "bench", "demo", "scripts", "examples", "testcluster")
        for file in (REPOSITORY / folder).rglob("*.py")
        if str(file.relative_to(REPOSITORY)) not in ELSEWHERE
    ]
    found = [
        f"{file.relative_to(REPOSITORY)}:{number}"
        for file in files
        for number, line in enumerate(file.read_text().splitlines(), 1)
        if re.search(r"""["']#[0-9a-fA-F]{3}(?:[0-9a-fA-F]{3})?["']""", line)
    ]
    assert found == [], "take it from understudy.cli.common.palette"


def test_a_pale_colour_is_between_itself_and_white() -> None:
    assert palette.pale("#000000", 0.5) == "#808080"
    assert palette.pale(palette.BLUE, 1) == palette.BLUE
