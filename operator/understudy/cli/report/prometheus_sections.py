"""The part of the page that a Prometheus has told: what its figures are, what they lack, figures and tables; pure."""

from __future__ import annotations

from collections.abc import Iterator

from understudy.cli.common.wording import clock, counted
from understudy.cli.report import charts, histogram_charts, html_tables
from understudy.cli.report.histogram_charts import CALLED
from understudy.cli.report.histograms import Histogram
from understudy.cli.report.html_markup import Markup, element
from understudy.cli.report.html_tables import Cell, number, seconds
from understudy.cli.report.prometheus_figures import Measured

_KINDS = {"Recovery": "recovery", "Switchover": "switchover, planned", "Held": "failure not recovered at once"}


def whole_period(measured: Measured) -> Iterator[Markup]:
    """All recoveries of the period, in figures and not one by one."""
    yield element("h2", "The whole period, by Prometheus")
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
            element("strong", "It has nothing of these robots' monitors in this period. "),
            f"{measured.url} answered, and has no series of them: does it scrape the monitors, and give their series the label "
            "workload? What there is to be scraped is told by docs/metrics.md; how long it keeps what it has, by its own configuration.",
            class_="card warn",
        )
    told = (
        f"The figures under this heading, and no others, come from Prometheus at {measured.url}. They are of every recovery that a "
        "monitor counted, also of those of which the status has no record any more and of robots that are gone; how long each one took "
        "isn't known, only how many took how long at most. Whether a failure was a false alarm nobody in the cluster knows, so none is "
        "counted."
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
            f"Monitors were told of at {len(measured.seen)} of {measured.asked} moments, first at {clock(first)}, last at {clock(last)}. "
            "What they counted while nobody asked is in here where they lived on, and is missing where they didn't."
        )
    if measured.missed:
        yield (
            f"The operator's own count, which outlives monitors, grew by {measured.recovered}: "
            f"{counted(measured.missed, 'recovery is', 'recoveries are')} missing in the figures below. A monitor takes with it what it "
            "counted since it was scraped last; and of one that is older than the period and was scraped in it for the first time, the "
            "first recovery by each strategy isn't seen."
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
        "Recoveries by strategy and result, by Prometheus", ("What", "Strategy, or by what", "Result", "n"), rows
    )


def _state(result: str) -> str:
    return {"Recovered": "good", "Failed": "bad"}.get(result, "")


def _times(measured: Measured) -> Iterator[Markup]:
    yield element("h3", "The four times, by strategy")
    if not measured.times:
        yield element("p", "Of no recovery in this period the times are known.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(*CALLED.items(), ("median", "p50"), ("tail", "p95")),
        histogram_charts.recovery_times(measured),
        element(
            "figcaption",
            "How many recoveries took how long, by strategy and part, and in all. Logarithmic axis, which begins at the left with all that "
            "took no longer than the first bound. Quantiles lie linearly between the two bounds about them; means are exact.",
        ),
    )
    rows = [
        [Cell(strategy), Cell(CALLED[part]), *_figures(histogram)]
        for strategy in measured.strategies
        for part, histogram in measured.of(strategy).items()
    ]
    yield html_tables.table("The four times by strategy, by Prometheus", ("Strategy", "Part", *_HEAD), rows)


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
        yield html_tables.table("Other times, by Prometheus", ("What", *_HEAD), rows)


def _pools(measured: Measured) -> Iterator[Markup]:
    yield element("h3", "Pools")
    if not measured.pools:
        yield element("p", "It has nothing of pools here: there is none, or the operator isn't scraped.", class_="card")
        return
    yield element(
        "figure",
        charts.legend(("ready", "ready"), ("wanted", "should be there")),
        histogram_charts.pools(measured),
        element(
            "figcaption",
            f"Pods that aren't claimed, by pool, in UTC; looked at every {html_tables.span(measured.step)}.",
        ),
    )
    head = (
        "Pool",
        "Desired at the end",
        "Ready, at least",
        "Ready, mean",
        "Claimed, at most",
        "Robots waiting, at most",
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
    yield html_tables.table("Pools over the period, by Prometheus", head, rows)
