"""Draws the charts of the data from Prometheus as SVG. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from understudy.cli.common.text.time_bars import NAMES, length
from understudy.cli.common.text.wording import clock, counted
from understudy.cli.report.drawing.axes import ROOM, figure, grid, marks, percent, tick
from understudy.cli.report.drawing.html_markup import Markup, element, joined
from understudy.cli.report.prometheus.histograms import Histogram
from understudy.cli.report.prometheus.prometheus_figures import WHOLE, Measured

CALLED = {**NAMES, WHOLE: "recovery time"}
"""Labels of the parts and of the recovery time."""

_FIRST = 6.0
"""Percent of the width for times below the first bound, which a logarithmic axis cannot show."""

_TALL = 20
"""Height of the highest bar in pixels."""


def recovery_times(measured: Measured) -> Markup:
    """Draw a histogram of each part by strategy, on a logarithmic axis because a switch and a start differ by orders of magnitude."""
    bounds = sorted({bound for time in measured.times for bound in time.histogram.bounds})
    low, high = math.log10(bounds[0]), math.log10(bounds[-2])

    def place(seconds: float) -> float:
        if seconds < bounds[0]:
            return _FIRST * seconds / bounds[0]
        if math.isinf(seconds):
            return 100.0
        return _FIRST + (math.log10(seconds) - low) / (high - low) * (ROOM - _FIRST)

    rows, said, top = [], [], 8
    for strategy in measured.strategies:
        parts = measured.of(strategy)
        rows.append(element("text", strategy, x="0", y=top + 12, class_="head"))
        top += 18
        for part, histogram in parts.items():
            told = f"{CALLED[part]}: {quantiles(histogram)}"
            said.append(f"{strategy}, {told}")
            rows.append(element("text", told, x="0", y=top + 11, class_="note"))
            rows += _bars(histogram, part, place, top + 15)
            rows += marks(histogram.quantile(0.5), histogram.quantile(0.95), place, top + 15, _TALL + 2)
            top += 21 + _TALL
        top += 10
    decades = [10.0**e for e in range(math.ceil(low - 1e-9), math.floor(high + 1e-9) + 1)]
    return figure(
        "Distribution of the time of each part",
        "; ".join(said),
        joined(grid(((place(s), tick(s)) for s in decades), 8, top - 14), *rows),
        top + 20,
    )


def quantiles(histogram: Histogram) -> str:
    """Describe a histogram in a few words."""
    p50, p95 = (
        f"{'≥ ' if histogram.is_beyond(fraction) else ''}{length(histogram.quantile(fraction))}"
        for fraction in (0.5, 0.95)
    )
    return f"p50 {p50}, p95 {p95}, n = {histogram.count}"


def _bars(histogram: Histogram, part: str, place: Callable[[float], float], top: int) -> Iterator[Markup]:
    most = max(bucket.count for bucket in histogram.buckets())
    for bucket in histogram.buckets():
        if round(bucket.count) < 1:
            continue
        tall = max(1.5, bucket.count / most * _TALL)
        begin, end = place(bucket.above), place(bucket.most)
        until = f"more than {length(bucket.above)}" if math.isinf(bucket.most) else f"up to {length(bucket.most)}"
        yield element(
            "rect",
            element("title", f"{CALLED[part]}, {until}: {round(bucket.count)}"),
            x=percent(begin),
            y=top + _TALL - tall,
            width=percent(end - begin),
            height=tall,
            class_=f"part {part}",
        )


def pools(measured: Measured) -> Markup:
    """Draw ready and desired pods of each pool over the period."""
    period, found, step = measured.period, measured.pools, measured.step
    rows, height, wide = [], 66, 1000.0

    def along(moment: float) -> float:
        return (moment - period.begin) / period.length * wide

    for number, pool in enumerate(found):
        top = 8 + number * height
        most = max((value for _, value in (*pool.ready, *pool.wanted)), default=0.0) or 1.0
        rows.append(element("text", measured.named(pool), x="0", y=top + 12, class_="head"))
        note = f"up to {counted(round(most), 'pod')}"
        rows.append(element("text", note, x="100%", y=top + 12, text_anchor="end", class_="note"))
        drawn = [
            element("path", d=_line([(at, 36 - value / most * 34) for at, value in points], step, along), class_=kind)
            for points, kind in ((pool.ready, "ready"), (pool.wanted, "wanted"))
        ]
        # The path is stretched to the width; lines and letters are not.
        box = {"viewBox": f"0 0 {wide:g} 38", "preserveAspectRatio": "none"}
        rows.append(element("svg", *drawn, x="0", y=top + 18, width="100%", height=38, **box))
    bottom = len(found) * height + 8
    return figure(
        "Pods of pools over time",
        "; ".join(f"{measured.named(pool)}: at least {pool.least_ready:g} ready" for pool in found),
        joined(
            grid(((share * 100, "") for share in (0.0, 0.25, 0.5, 0.75, 1.0)), 8, bottom - 8),
            *rows,
            element("text", clock(period.begin), x="0", y=bottom + 18, class_="axis"),
            element("text", clock(period.end), x="100%", y=bottom + 18, text_anchor="end", class_="axis"),
        ),
        bottom + 26,
    )


def _line(points: Sequence[tuple[float, float]], step: float, along: Callable[[float], float]) -> str:
    """Build a step line through the points, with gaps for missing points."""
    drawn, before = [], -math.inf
    for at, height in points:
        begin = "L" if at - before < 1.5 * step else "M"
        drawn.append(f"{begin}{along(at):.1f} {height:.1f}H{along(at + step):.1f}")
        before = at
    return "".join(drawn)
