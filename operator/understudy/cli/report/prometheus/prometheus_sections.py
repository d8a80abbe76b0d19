"""Builds the section with the data of Prometheus: its source, what is missing, charts and tables. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from understudy.cli.common.text.wording import clock, counted
from understudy.cli.report.drawing import charts, histogram_charts, html_tables
from understudy.cli.report.drawing.histogram_charts import CALLED
from understudy.cli.report.drawing.html_markup import Markup, element
from understudy.cli.report.drawing.html_tables import Cell, number, seconds
from understudy.cli.report.prometheus.histograms import Histogram
from understudy.cli.report.prometheus.prometheus_figures import Measured

_KINDS = {"Recovery": "recovery", "Switchover": "switchover, planned", "Held": "deferred recovery"}


def whole_period(measured: Measured) -> Iterator[Markup]:
    """Build the section about all recoveries of the period."""
    yield element("h2", "The whole period, from Prometheus")
    yield _source(measured)
    if not measured.seen:
        return
    yield from _counts(measured)
    yield from _times(measured)
    yield from _steps(measured)
    yield from _pools(measured)


def _source(measured: Measured) -> Markup:
    if not measured.seen:
        return element(
            "section",
            element("strong", "Prometheus has no data on these robots in this period. "),
            f"{measured.url} answered, but has no series of them: does it scrape the monitors, and do their series have the label "
            "workload? See docs/metrics.md for the targets to scrape, and its configuration for the retention time.",
            class_="card warn",
        )
    told = (
        f"Only the figures in this section come from Prometheus at {measured.url}. They include every recovery that a "
        "monitor counted, also recoveries that are no longer recorded and robots that were deleted. Single times are "
        "not known, only their distribution. The cluster does not know which failures were false alarms, so they are not "
        "counted separately."
    )
    lacking = list(_lacking(measured))
    if not lacking:
        return element("p", told, class_="card")
    return element(
        "section", element("p", told), element("ul", *(element("li", one) for one in lacking)), class_="card warn"
    )


def _lacking(measured: Measured) -> Iterator[str]:
    first, last = measured.seen[0], measured.seen[-1]
    absent = measured.asked - len(measured.seen)
    if absent:
        yield (
            f"There is data of monitors at {len(measured.seen)} of {measured.asked} times, first at {clock(first)}, last at {clock(last)}. "
            "Recoveries between two scrapes are included if the monitor kept running, and missing if it did not."
        )
    if measured.missed:
        yield (
            f"The operator's own count, which outlives monitors, grew by {measured.recovered}: "
            f"{counted(measured.missed, 'recovery is', 'recoveries are')} missing in the figures below. A deleted monitor loses what it "
            "counted since its last scrape. For a monitor that is older than the period and was first scraped in it, the "
            "first recovery by each strategy is missing."
        )


def _counts(measured: Measured) -> Iterator[Markup]:
    yield element("h3", "Recoveries by strategy and result")
    if not measured.counts:
        yield element("p", "No monitor counted a recovery in this period.", class_="card")
        return
    rows = [
        [
            Cell(_KINDS[count.kind]),
            Cell(count.how),
            Cell(count.result or "–", state=_state(count.result)),
            number(count.count),
        ]
        for count in measured.counts
    ]
    yield html_tables.table(
        "Recoveries by strategy and result, from Prometheus", ("Kind", "Strategy or reason", "Result", "n"), rows
    )


def _state(result: str) -> str:
    return {"Recovered": "good", "Failed": "bad"}.get(result, "")


def _times(measured: Measured) -> Iterator[Markup]:
    yield element("h3", "The parts of the recovery time, by strategy")
    if not measured.times:
        yield element("p", "There are no times of recoveries in this period.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*CALLED.items(), ("median", "p50"), ("tail", "p95")),
        histogram_charts.recovery_times(measured),
        element(
            "figcaption",
            "Distribution of the times by strategy and part, and of the recovery time. Logarithmic axis; the first bar contains all that "
            "are not above the first bound. Quantiles are interpolated linearly between two bounds; means are exact.",
        ),
    )
    rows = [
        [Cell(strategy), Cell(CALLED[part]), *_figures(histogram)]
        for strategy in measured.strategies
        for part, histogram in measured.of(strategy).items()
    ]
    yield html_tables.table(
        "The parts of the recovery time by strategy, from Prometheus", ("Strategy", "Part", *_HEAD), rows
    )


_HEAD = ("n", "Mean", "p50", "p95", "p99")


def _figures(histogram: Histogram) -> list[Cell]:
    return [
        number(histogram.count),
        seconds(histogram.mean),
        *(seconds(histogram.quantile(f), at_least=histogram.is_beyond(f)) for f in (0.5, 0.95, 0.99)),
    ]


def _steps(measured: Measured) -> Iterator[Markup]:
    if measured.steps:
        yield element("h3", "Other times")
        rows = [[Cell(step.name), *_figures(step.histogram)] for step in measured.steps]
        yield html_tables.table("Other times, from Prometheus", ("What", *_HEAD), rows)


def _pools(measured: Measured) -> Iterator[Markup]:
    yield element("h3", "Pools")
    if not measured.pools:
        yield element("p", "There is no data on pools: there are none, or the operator is not scraped.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(("ready", "ready"), ("wanted", "desired")),
        histogram_charts.pools(measured),
        element(
            "figcaption",
            f"Pods that are not claimed, by pool, in UTC; sampled every {html_tables.span(measured.step)}.",
        ),
    )
    head = (
        "Pool",
        "Desired at the end",
        "Ready, minimum",
        "Ready, mean",
        "Claimed, maximum",
        "Robots waiting, maximum",
    )
    rows = [
        [
            Cell(measured.named(pool)),
            number(round(pool.desired)),
            Cell(
                f"{pool.least_ready:g}",
                pool.least_ready,
                "bad" if pool.desired and not pool.least_ready else "",
                number=True,
            ),
            Cell(f"{pool.mean_ready:.3g}", pool.mean_ready, number=True),
            number(round(pool.most_claimed)),
            number(round(pool.most_waiting)),
        ]
        for pool in measured.pools
    ]
    yield html_tables.table("Pools over the period, from Prometheus", head, rows)
