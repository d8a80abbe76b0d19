"""Accessible HTML tables, sortable if scripts run, with exact values in addition to the text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from understudy.cli.common.text.time_bars import length
from understudy.cli.common.text.wording import clock
from understudy.cli.report.drawing.html_markup import Markup, element, joined


class Cell(NamedTuple):
    """One cell of a table."""

    shown: str
    value: float | None = None
    """The sort key; the text if None."""
    state: str = ""
    """The state whose colour it has."""
    number: bool = False
    """Whether it is a number, which is aligned to the right."""


def seconds(value: float | None, *, at_least: bool = False) -> Cell:
    """Build a cell for a duration."""
    if value is None:
        return Cell("–", number=True)
    return Cell(f"{'≥ ' if at_least else ''}{span(value)}", value, number=True)


def span(value: float) -> str:
    """Format a duration in seconds, short or long, with its significant digits."""
    if value < 120:
        return length(value)
    return f"{value / 60:.1f} min" if value < 7200 else f"{value / 3600:.1f} h"


def number(value: int) -> Cell:
    """Build a cell for a count."""
    return Cell(str(value), value, number=True)


def moment(value: float) -> Cell:
    """Build a cell for a time in UTC."""
    return Cell(clock(value), value)


def table(caption: str, rows: Sequence[Mapping[str, Cell]], *, sortable: bool = False) -> Markup:
    """Build a table of at least one row in a box that scrolls sideways in a narrow window. Each row has its cells by column."""
    heads = [
        element(
            "th",
            element("button", label, type="button") if sortable else label,
            scope="col",
            class_="number" if cell.number else None,
        )
        for label, cell in rows[0].items()
    ]
    body = [element("tr", *(_drawn(cell, first=index == 0) for index, cell in enumerate(row.values()))) for row in rows]
    drawn = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *heads)),
        element("tbody", *body),
        class_="sortable" if sortable else None,
    )
    return element("div", drawn, class_="scroll", role="region", aria_label=caption, tabindex="0")


def _drawn(cell: Cell, *, first: bool) -> Markup:
    classes = " ".join(c for c in ("number" if cell.number else "", cell.state) if c)
    return element(
        "th" if first else "td",
        joined(cell.shown),
        scope="row" if first else None,
        data_value=repr(cell.value) if cell.value is not None else None,
        class_=classes or None,
    )
