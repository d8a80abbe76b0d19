"""Draws the charts as SVG. Horizontal positions are percentages, so a chart fits a telephone without scaling its letters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count

from understudy.cli.common.text.time_bars import NAMES, length
from understudy.cli.common.text.wording import clock, counted
from understudy.cli.report.drawing.axes import ROOM, figure, grid, marks, percent, tick, ticks
from understudy.cli.report.drawing.html_markup import Markup, element, joined
from understudy.cli.report.drawing.html_tables import span
from understudy.cli.report.recovery_records import Entry, Findings, Group, RobotPeriod, Span
from understudy.cli.report.reserved_resources import ROLES, Share
from understudy.cli.report.sample_statistics import Spread

_JITTER = (0, 4, -4, 7, -7)
"""Vertical offsets of successive marks in pixels, so that equal values remain distinguishable."""

_LEAST_SHOWN = 0.15
"""Least width of an outage in percent: most are shorter than a pixel."""


_LEAST_GAP = 0.001
"""Least gap in seconds on the logarithmic axis; with the reflex there may be no gap at all."""


def recovery_times(groups: Sequence[Group]) -> Markup:
    """Draw the mean of each part of the recovery time by strategy, stacked as in the paper, with a dot per recovery."""
    most = max((group.spread.greatest for group in groups), default=0.0) or 1.0
    steps = list(ticks(most))
    most = max(most, steps[-1])

    def place(seconds: float) -> float:
        return seconds / most * ROOM

    rows, height = list[Markup](), 78
    for number, group in enumerate(groups):
        top = 8 + number * height
        rows += _heading(group.name, f"{_quantiles(group.spread)}, n = {group.spread.count}", top)
        parts = [(part, f"{NAMES[part]}: mean {length(seconds)}", seconds) for part, seconds in group.parts.items()]
        rows += _stacked(parts, place, top + 34)
        rows += marks(group.spread.p50, group.spread.p95, place, top + 30, 26)
        rows += _dots(group.entries, group.times, place, top + 65)
    words = [_describe(group.name, group.spread) for group in groups]
    return _chart("Recovery time by strategy", words, [(place(s), tick(s)) for s in steps], rows, height)


def gaps(groups: Sequence[Group]) -> Markup:
    """Draw the gaps by strategy, on a logarithmic axis because a switchover and a restart differ by orders of magnitude."""
    known = [gap for group in groups for gap in group.gaps]
    low = math.floor(math.log10(max(min(known), _LEAST_GAP)))
    high = max(low + 1, math.ceil(math.log10(max(max(known), _LEAST_GAP))))

    def place(seconds: float) -> float:
        share = (math.log10(max(seconds, 10.0**low)) - low) / (high - low)
        return 1.0 + share * (ROOM - 1.0)

    rows, height = list[Markup](), 72
    for number, group in enumerate(groups):
        top, spread = 8 + number * height, Spread.of(group.gaps)
        entries = [entry for entry in group.entries if entry.gap is not None]
        rows += _heading(group.name, f"{_quantiles(spread)}, n = {spread.count}", top)
        rows += marks(spread.p50, spread.p95, place, top + 33, 24)
        rows += _dots(entries, group.gaps, place, top + 45)
    words = [_describe(group.name, Spread.of(group.gaps)) for group in groups]
    steps = [(place(10.0**e), tick(10.0**e)) for e in range(low, high + 1)]
    return _chart("Gap by strategy", words, steps, rows, height)


def reserved(shares: Sequence[Share]) -> Markup:
    """Draw the reserved CPU by strategy, stacked by role of the pods."""
    steps = list(ticks(max(share.total.cpu for share in shares) * 1000 or 1.0))

    def place(cpu: float) -> float:
        return cpu / steps[-1] * ROOM

    rows, height = list[Markup](), 62
    notes = [f"{milli(share.total.cpu)}, {_of(share)}" for share in shares]
    for number, (share, note) in enumerate(zip(shares, notes, strict=True)):
        top = 8 + number * height
        rows += _heading(share.name, note, top)
        parts = [(role, f"{ROLES[role]}: {milli(held.cpu)}", held.cpu * 1000) for role, held in share.roles.items()]
        rows += _stacked(parts, place, top + 33)
    words = [f"{share.name}: {note}" for share, note in zip(shares, notes, strict=True)]
    return _chart("Reserved CPU by strategy", words, [(place(s), f"{s:g} m") for s in steps], rows, height)


def _chart(
    title: str, words: Sequence[str], steps: Iterable[tuple[float, str]], rows: Iterable[Markup], height: int
) -> Markup:
    """Build a chart with a row of a height for each of the words."""
    bottom = len(words) * height
    return figure(title, "; ".join(words), joined(grid(steps, 8, bottom), *rows), bottom + 34)


def milli(cores: float) -> str:
    """Format an amount of CPU in milli-CPU."""
    return f"{cores * 1000:.4g} milli-CPU"


def _of(share: Share) -> str:
    return (
        counted(share.count, "pod")
        if "pool" in share.roles and len(share.roles) == 1
        else f"mean of {counted(share.count, 'robot')}"
    )


def _stacked(parts: Iterable[tuple[str, str, float]], place: Callable[[float], float], top: int) -> Iterator[Markup]:
    """Draw a stacked bar of parts: each with its kind, its tooltip and its amount."""
    begin = 0.0
    for kind, words, amount in parts:
        if amount > 0:
            yield _box(place(begin), place(amount), top, f"part {kind}", words)
        begin += amount


def _box(begin: float, wide: float, top: int, class_: str, words: str = "") -> Markup:
    """Draw a box with a tooltip; its place and its width are percentages."""
    title = element("title", words) if words else None
    return element("rect", title, x=percent(begin), y=top, width=percent(wide), height=18, class_=class_)


def timeline(findings: Findings) -> Markup:
    """Draw the events of each robot over the period, and the time without records."""
    period = findings.period

    def place(moment: float) -> float:
        return 1.5 + (moment - period.begin) / period.length * (ROOM - 1.5)

    rows, height = [], 50
    for number, robot_period in enumerate(findings.eventful):
        top = 8 + number * height
        rows.append(element("text", findings.named(robot_period.robot), x="0", y=top + 14, class_="head"))
        rows.append(
            element("text", _recovery_count(robot_period), x="100%", y=top + 14, text_anchor="end", class_="note")
        )
        rows += _lane(robot_period, period, place, top + 20)
    ends = [(place(period.begin + period.length * share), "") for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    bottom = len(findings.eventful) * height + 8
    return figure(
        "Recoveries over time",
        "; ".join(
            f"{findings.named(robot_period.robot)}: {_recovery_count(robot_period)}"
            for robot_period in findings.eventful
        ),
        joined(
            grid(ends, 8, bottom - 8),
            *rows,
            element("text", clock(period.begin), x="0", y=bottom + 18, class_="axis"),
            element("text", clock(period.end), x="100%", y=bottom + 18, text_anchor="end", class_="axis"),
        ),
        bottom + 26,
    )


def legend(*entries: tuple[str, str]) -> Markup:
    """Build the legend of a chart."""
    return element("ul", *(element("li", swatch(kind), words) for kind, words in entries), class_="legend")


def swatch(kind: str) -> Markup:
    """Build the symbol of a legend entry."""
    drawn = _mark(kind) if kind in _MARKS else element("rect", x="-6", y="-6", width="12", height="12", class_=kind)
    return element("svg", drawn, width="14", height="14", viewBox="-7 -7 14 14", aria_hidden="true", class_="swatch")


_MARKS = {
    "dot": '<circle r="3.5" class="dot"/>',
    "recovered": '<circle r="5.5" class="recovered"/>',
    "planned": '<path d="M0-6.5 6.5 0 0 6.5-6.5 0Z" class="planned"/>',
    "failed": '<path d="M-5-5 5 5M5-5-5 5" class="failed"/>',
    "median": '<path d="M0-7V7" class="median"/>',
    "tail": '<path d="M0-7V7" class="tail"/>',
}


def _mark(kind: str) -> Markup:
    return Markup(_MARKS[kind])


def kind_of(entry: Entry) -> str:
    """Return the mark of a recovery."""
    return "failed" if entry.failed else "recovered" if entry.of_failure else "planned"


def describe_recovery(entry: Entry) -> str:
    """Describe a recovery in a few words."""
    how = f"{length(entry.down)} by {entry.group}" if entry.recovered else "failed"
    return f"{entry.name} #{entry.recovery.number}, {clock(entry.began)}: {how}"


def _lane(robot_period: RobotPeriod, period: Span, place: Callable[[float], float], top: int) -> Iterator[Markup]:
    def wide(time: Span) -> float:
        return place(time.end) - place(time.begin)

    yield _box(place(period.begin), wide(period), top, "unknown")
    if robot_period.known is not None:
        yield _box(place(robot_period.known.begin), wide(robot_period.known), top, "known")
    for outage in robot_period.outages:
        words = f"outage of {span(outage.span.length)}"
        yield _box(place(outage.span.begin), max(_LEAST_SHOWN, wide(outage.span)), top, "outage", words)
    for entry in reversed(robot_period.entries):
        yield _at(percent(place(entry.began)), top + 9, kind_of(entry), describe_recovery(entry))


def _recovery_count(robot_period: RobotPeriod) -> str:
    return counted(len(robot_period.entries), "recovery", "recoveries")


def _heading(name: str, note: str, top: int) -> Iterator[Markup]:
    yield element("text", name, x="0", y=top + 12, class_="head")
    yield element("text", note, x="0", y=top + 27, class_="note")


def _quantiles(spread: Spread) -> str:
    return f"p50 {length(spread.p50)}, p95 {length(spread.p95)}"


def _dots(
    entries: Sequence[Entry], values: Sequence[float], place: Callable[[float], float], middle: int
) -> Iterator[Markup]:
    for entry, value, number in zip(entries, values, count(), strict=False):
        yield _at(percent(place(value)), middle + _JITTER[number % len(_JITTER)], "dot", describe_recovery(entry))


def _at(x: str, y: float, mark: str, words: str) -> Markup:
    """Draw a mark with a tooltip."""
    return element(
        "svg", element("g", element("title", words), _mark(mark)), x=x, y=y, width=1, height=1, overflow="visible"
    )


def _describe(name: str, spread: Spread) -> str:
    return f"{name}: n = {spread.count}, mean {length(spread.mean)}, {_quantiles(spread)}"
