"""Draws diagrams of boxes, arrows and words as SVG that a browser shows without scripts or fonts of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from xml.sax.saxutils import escape, quoteattr

INK, PALE = "#22303c", "#6b7680"
BLUE, RED, PURPLE, AMBER = "#1b5e8c", "#b83227", "#5f4690", "#a97b10"
WHITE = "#ffffff"

_FONT = "Helvetica, Arial, 'DejaVu Sans', sans-serif"
_LINE = 16
"""Distance between two lines of text."""

Point = tuple[float, float]


@dataclass
class Diagram:
    """One picture, in pixels from its upper left corner. Later elements cover earlier ones."""

    width: int
    height: int
    title: str
    description: str
    """The description for screen readers."""
    _parts: list[str] = field(default_factory=list)
    _heads: set[str] = field(default_factory=set)

    def part(self, name: str) -> None:
        """Start a part with a name, for readers of the file."""
        self._parts += ["", f"<!-- {escape(name)} -->"]

    def text(
        self, at: Point, words: str, colour: str = INK, *, size: int = 12, bold: bool = False, anchor: str = "middle"
    ) -> None:
        """Draw one line of text; ``at`` is the position of its middle (or of its start or end)."""
        weight = ' font-weight="bold"' if bold else ""
        self._parts.append(
            f'<text x="{at[0]:g}" y="{at[1]:g}" text-anchor="{anchor}" font-size="{size}"{weight} fill="{colour}">{escape(words)}</text>'
        )

    def box(
        self,
        corner: Point,
        size: Point,
        colour: str,
        fill: str = WHITE,
        *,
        title: str = "",
        lines: Sequence[tuple[str, str]] = (),
        dashed: bool = False,
        titled: str = "",
    ) -> None:
        """Draw a box with a title and lines of text (each with its colour) in its middle; ``titled`` is the title's
        colour."""
        dashes = ' stroke-dasharray="7 4"' if dashed else ""
        self._parts.append(
            f'<rect x="{corner[0]:g}" y="{corner[1]:g}" width="{size[0]:g}" height="{size[1]:g}" rx="7" fill="{fill}" '
            f'stroke="{colour}" stroke-width="1.7"{dashes}/>'
        )
        middle = corner[0] + size[0] / 2
        top = corner[1] + (size[1] - _LINE * len(lines) - (20 if title else 0)) / 2
        if title:
            self.text((middle, top + 15), title, titled or colour, size=15, bold=True)
            top += 20
        for number, (words, ink) in enumerate(lines):
            self.text((middle, top + 12 + _LINE * number), words, ink)

    def line(
        self, points: Sequence[Point], colour: str, width: float = 2.0, *, head: bool = False, dashes: str = ""
    ) -> None:
        """Draw a line through points, with an arrow head at its end if requested."""
        path = " L".join(f"{x:g} {y:g}" for x, y in points)
        more = f' stroke-dasharray="{dashes}"' if dashes else ""
        if head:
            self._heads.add(colour)
            more += f' marker-end="url(#{_head(colour)})"'
        self._parts.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="{width:g}"{more}/>')

    def cross(self, at: Point, colour: str = RED) -> None:
        """Draw a cross, which marks where something is blocked."""
        (x, y), arm = at, 7
        for step in (arm, -arm):
            self.line([(x - arm, y - step), (x + arm, y + step)], colour, 2.6)

    def svg(self) -> str:
        """Return the whole file."""
        heads = [
            f'<marker id="{_head(colour)}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
            f'<path d="M0 0 10 5 0 10z" fill="{colour}"/></marker>'
            for colour in sorted(self._heads)
        ]
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" font-family={quoteattr(_FONT)} '
            'role="img" aria-labelledby="title description">',
            "<!-- Written by scripts/generate from scripts/generation/diagrams.py: change that. -->",
            f'<title id="title">{escape(self.title)}</title>',
            f'<desc id="description">{escape(self.description)}</desc>',
            "<defs>",
            *heads,
            "</defs>",
            f'<rect width="{self.width}" height="{self.height}" fill="{WHITE}"/>',
            *self._parts,
            "</svg>",
        ]
        return "\n".join(lines) + "\n"


def _head(colour: str) -> str:
    return f"head-{colour.removeprefix('#')}"
