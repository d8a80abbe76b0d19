"""Shared parts of the SVG charts: axes, whose positions are percentages of the width. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from understudy.cli.common.text.time_bars import length
from understudy.cli.report.drawing.html_markup import Markup, element, joined

ROOM = 97.0
"""Percent of the width for the data: marks at the end need the rest."""


def figure(title: str, description: str, drawn: Markup, height: int) -> Markup:
    """Build a chart with a description for screen readers."""
    return element(
        "svg",
        element("title", title),
        element("desc", description),
        drawn,
        role="img",
        aria_label=f"{title}: {description}",
        width="100%",
        height=height,
        class_="chart",
    )


def marks(p50: float, p95: float, place: Callable[[float], float], top: int, height: int) -> Iterator[Markup]:
    """Draw lines at two quantiles."""
    for value, words, class_ in ((p50, "p50", "median"), (p95, "p95", "tail")):
        at = percent(place(value))
        yield element(
            "line", element("title", f"{words}: {length(value)}"), x1=at, x2=at, y1=top, y2=top + height, class_=class_
        )


def grid(places: Iterable[tuple[float, str]], top: int, height: int) -> Markup:
    """Draw grid lines with labels below them."""
    drawn = []
    for at, words in places:
        drawn.append(element("line", x1=percent(at), x2=percent(at), y1=top, y2=top + height, class_="grid"))
        if words:
            anchor = "start" if at < 4 else "end" if at > 92 else "middle"
            drawn.append(element("text", words, x=percent(at), y=top + height + 16, text_anchor=anchor, class_="axis"))
    return joined(*drawn)


def ticks(most: float) -> Iterator[float]:
    """Yield round values from 0 to at least the greatest value, at most six."""
    rough = most / 4
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * unit for factor in (1, 2, 5, 10) if factor * unit >= rough)
    yield from (number * step for number in range(math.ceil(most / step - 1e-9) + 1))


def tick(seconds: float) -> str:
    """Format a round duration."""
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1000:g} ms" if seconds else "0"


def percent(value: float) -> str:
    """Format a share of the width."""
    return f"{value:.3f}%"
