"""A recording as an animated SVG: text as text, without scripts, which GitHub shows where it shows pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from xml.sax.saxutils import escape

from understudy_demo.recording.asciicast import Cast, Frame, frames
from understudy_demo.recording.screen import Row, Style

HOLD = 4.0
"""Seconds for which the last frame stands before it begins again."""

_WIDTH, _HEIGHT, _BASE, _SIZE = 9.0, 19, 14, 15
"""Of a character's cell, where in it the text stands, and the size of the letters."""
_MARGIN = 14
_FONTS = 'ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace'

_BACKGROUND, _FOREGROUND, _BORDER = "#10151c", "#d5dbe3", "#3a4553"
_COLOURS = ("#5c6773", "#ff6b6b", "#7ddb7f", "#f2c94c", "#74b3ff", "#e39bf0", "#5fd7e0", "#d5dbe3")
_FAINT = "#7d8896"

_BLOCKS = {
    "░": (1.0, 0.3),
    "▒": (1.0, 0.5),
    "▓": (1.0, 0.75),
    **{block: (n / 8, 1.0) for n, block in enumerate(" ▏▎▍▌▋▊▉█") if n},
}
"""Characters that are drawn as areas, without seams and with every font: how much of their cell they fill, and how opaque they are."""

_PIECES = re.compile(
    rf"(?P<block>[{''.join(_BLOCKS)}])(?P=block)*|[^\s{''.join(_BLOCKS)}]+(?: [^\s{''.join(_BLOCKS)}]+)*"
)
"""An area, or words with single blanks between them: how many blanks there are is not left to who shows it."""


@dataclass(frozen=True)
class _Stay:
    """A row as it was from one moment to another."""

    number: int
    row: Row
    begin: float
    end: float


def render(cast: Cast) -> str:
    """The picture. The same recording always comes to the same one."""
    played = frames(cast)
    length = cast.length + HOLD
    stays = [
        stay
        for stay in _stays(played, length)
        if any(character != " " or style.reverse for character, style in stay.row)
    ]
    spans = sorted({(stay.begin, stay.end) for stay in stays if (stay.begin, stay.end) != (0.0, length)})
    names = {span: f"k{number}" for number, span in enumerate(spans)}
    width, height = cast.columns * _WIDTH + 2 * _MARGIN, cast.rows * _HEIGHT + 2 * _MARGIN
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" role="img">',
            f"<title>{escape(cast.title)}</title>",
            "<style>",
            *_style(length),
            *(_keyframes(name, span, length) for span, name in names.items()),
            "</style>",
            f'<rect x="0.5" y="0.5" width="{width - 1:g}" height="{height - 1:g}" rx="8" fill="{_BACKGROUND}" stroke="{_BORDER}"/>',
            *(_drawn(stay, names.get((stay.begin, stay.end)), length) for stay in stays),
            # How far it is.
            f'<rect class="p" x="{_MARGIN}" y="{height - 6:g}" width="{width - 2 * _MARGIN:g}" height="2" fill="{_BORDER}"/>',
            "</svg>\n",
        ]
    )


def _style(length: float) -> Iterator[str]:
    yield f"g{{font:{_SIZE}px {_FONTS};fill:{_FOREGROUND}}}"
    yield from (f".c{number}{{fill:{colour}}}" for number, colour in enumerate(_COLOURS))
    yield f".f{{fill:{_FAINT}}}.b{{font-weight:bold}}.r{{fill:{_BACKGROUND}}}"
    yield f".a{{animation:{length:.3f}s step-end infinite}}.h{{visibility:hidden}}"
    yield f"@keyframes p{{from{{transform:scaleX(0)}}}}.p{{animation:p {length:.3f}s linear infinite;transform-origin:{_MARGIN}px 0}}"
    # Who wants nothing to move sees how it ended.
    yield "@media (prefers-reduced-motion:reduce){.a,.p{animation:none}}"


def _stays(played: Sequence[Frame], length: float) -> Iterator[_Stay]:
    """How long each row was as it was; the first frame is there from the beginning."""
    starts = [0.0, *(frame.time for frame in played[1:])]
    ends = [*starts[1:], length]
    for number in range(len(played[0].rows)):
        timed = [(frame.rows[number], begin, end) for frame, begin, end in zip(played, starts, ends, strict=True)]
        for row, same in groupby(timed, key=lambda one: one[0]):
            moments = [moment for _, *span in same for moment in span]
            yield _Stay(number, row, moments[0], moments[-1])


def _keyframes(name: str, span: tuple[float, float], length: float) -> str:
    """Visible from one moment to another. Each of them holds until the next."""
    begin, end = (f"{100 * moment / length:.3f}%" for moment in span)
    visible, hidden = "{visibility:visible}", "{visibility:hidden}"
    told = [f"0%{visible}" if span[0] == 0 else f"0%{hidden}{begin}{visible}"]
    if span[1] < length:
        told.append(f"{end}{hidden}")
    return f"@keyframes {name}{{{''.join(told)}}}"


def _drawn(stay: _Stay, name: str | None, length: float) -> str:
    top = _MARGIN + stay.number * _HEIGHT
    texts = "".join(_texts(stay.row, top))
    if name is None:
        return f"<g>{texts}</g>"
    classes = "a" if stay.end == length else "a h"
    return f'<g class="{classes}" style="animation-name:{name}">{texts}</g>'


def _texts(row: Row, top: float) -> Iterator[str]:
    column = 0
    for style, cells in groupby(row, key=lambda cell: cell[1]):
        text = "".join(character for character, _ in cells)
        x = _MARGIN + column * _WIDTH
        if style.reverse:
            fill = _FOREGROUND if style.colour is None else _COLOURS[style.colour]
            yield f'<rect x="{x:g}" y="{top:g}" width="{len(text) * _WIDTH:g}" height="{_HEIGHT}" fill="{fill}"/>'
        for piece in _PIECES.finditer(text):
            left, length, look = x + piece.start() * _WIDTH, len(piece[0]) * _WIDTH, _classes(style)
            if piece["block"]:
                filled, opacity = _BLOCKS[piece["block"]]
                size = f'width="{length * filled:g}" height="{_HEIGHT - 2}"'
                yield f'<rect x="{left:g}" y="{top + 1:g}" {size} opacity="{opacity:g}"{look}/>'
                continue
            # Whatever font there is, it fills its cells.
            size = f'textLength="{length:g}" lengthAdjust="spacingAndGlyphs"'
            yield f'<text x="{left:g}" y="{top + _BASE:g}" {size}{look}>{escape(piece[0])}</text>'
        column += len(text)


def _classes(style: Style) -> str:
    colour = "r" if style.reverse else "f" if style.faint else "" if style.colour is None else f"c{style.colour}"
    told = [*([colour] if colour else []), *(["b"] if style.bold else [])]
    return f' class="{" ".join(told)}"' if told else ""
