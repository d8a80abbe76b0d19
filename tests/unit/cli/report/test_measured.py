"""What a Prometheus has told, in words, figures and data."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from math import inf

import pytest

from tests.support.html_pages import Read, value
from tests.unit.cli.report import fleet
from tests.unit.cli.report.fleet import DAY, HOSTILE, NOW
from understudy.cli.report.csv_sheets import sheets
from understudy.cli.report.page import page
from understudy.cli.report.prometheus.histograms import Histogram
from understudy.cli.report.prometheus.prometheus_figures import WHOLE, Count, Measured, Pool, Step, Time
from understudy.cli.report.prometheus.promql import came, selector
from understudy.cli.report.recovery_records import findings

URL = "http://localhost:9090"


def times(count: int, seconds: float) -> Histogram:
    """So many of one length, in a histogram with four bounds."""
    found = Histogram.of({bound: count * (seconds <= bound) for bound in (0.01, 0.1, 1.0, inf)}, count * seconds)
    assert found is not None
    return found


def measured(**more: object) -> Measured:
    step = DAY.length / 4
    looks = [DAY.begin + number * step for number in range(5)]
    pool = Pool("fleet", "spare", 4, 0, 2.5, 2, 1, [(at, 4.0) for at in looks], [(at, 4.0) for at in looks])
    given: dict[str, object] = {
        "counts": [
            Count("Recovery", "Restart", "Recovered", 3), Count("Recovery", "none", "Failed", 1),
            Count("Switchover", "Failover", "Recovered", 2), Count("Held", "BudgetSpent", "", 1),
        ],
        "times": [
            Time("Restart", "cluster", times(3, 3.0)), Time("Restart", "detection", times(3, 0.5)),
            Time("Restart", WHOLE, times(3, 3.5)), Time("Fallback/Executing", WHOLE, times(7, 0.5)),
        ],
        "steps": [Step("claim of a pod, won", times(5, 0.04))],
        "pools": [pool],
        "recovered": 6,
    }  # fmt: skip
    return Measured(URL, DAY, looks, 5, step, **(given | more))  # type: ignore[arg-type]


def read(told: Measured) -> Read:
    found = findings(fleet.robots(), DAY)
    return Read(page(found, sheets(found, told), where="namespace fleet", made=NOW, measured=told))


def test_its_figures_are_those_that_were_told_and_say_from_where() -> None:
    shown = read(measured())
    assert f"from Prometheus at {URL} in the section with that title" in shown.text
    assert f"Only the figures in this section come from Prometheus at {URL}." in shown.text
    rows = [[cell[0] for cell in row] for row in shown.table("Recoveries by strategy and result")]
    assert rows == [
        ["recovery", "Restart", "Recovered", "3"],
        ["recovery", "none", "Failed", "1"],
        ["switchover, planned", "Failover", "Recovered", "2"],
        ["deferred recovery", "BudgetSpent", "–", "1"],
    ]
    four = shown.table("The parts of the recovery time by strategy")
    assert [(row[0][0], row[1][0], value(row[2])) for row in four] == [
        ("Restart", "detection", 3), ("Restart", "cluster", 3), ("Restart", "recovery time", 3),
        ("Fallback/Executing", "recovery time", 7),
    ]  # fmt: skip
    assert (value(four[1][3]), four[1][4][0]) == (3.0, "≥ 1.00 s"), "beyond the last bound nobody knows"
    assert shown.table("Other times")[0][0][0] == "claim of a pod, won"
    assert [cell[0] for cell in shown.table("Pools over")[0]] == ["spare", "4", "0", "2.5", "2", "1"]
    described = [e["aria-label"] or "" for e in shown.all("svg") if e.get("role") == "img"]
    assert any("Restart, detection: p50 550 ms, p95 955 ms, n = 3" in words for words in described)
    assert any("spare: at least 0 ready" in words for words in described)


def test_bars_are_as_high_as_there_are_many() -> None:
    both = Histogram.of({0.01: 0, 0.1: 4, 1.0: 6, inf: 6}, 1.0)
    assert both is not None
    shown = read(measured(times=[Time("Restart", "startup", both)], steps=[], pools=[]))
    bars = [e for e in shown.all("rect") if e["class"] == "part startup" and e.get("height") != "18"]
    assert [float(bar["height"] or "") for bar in bars] == [20.0, 10.0]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"recovered": 9}, "The operator's own count, which outlives monitors, grew by 9: 3 recoveries are missing"),
        ({"seen": [DAY.begin + 7200]}, "There is data of monitors at 1 of 5 times, first at 2026-11-21 16:06:24Z, last at"),
        ({"seen": []}, "Prometheus has no data on these robots in this period."),
        ({"counts": [], "recovered": None}, "No monitor counted a recovery in this period."),
        ({"times": []}, "There are no times of recoveries in this period."),
        ({"pools": []}, "There is no data on pools: there are none, or the operator is not scraped."),
    ],
)  # fmt: skip
def test_missing_figures_are_reported(more: dict[str, object], words: str) -> None:
    assert words in read(replace(measured(), **more)).text  # type: ignore[arg-type]


def test_names_of_other_origin_are_escaped() -> None:
    pool = Pool("fleet", HOSTILE, 1, 1, 1, 0, 0, [], [])
    shown = read(
        measured(
            counts=[Count("Recovery", HOSTILE, HOSTILE, 1)], times=[Time(HOSTILE, WHOLE, times(1, 0.5))], pools=[pool]
        )
    )
    assert len(shown.all("script")) == 1
    assert shown.all("img") == []


def test_the_data_is_as_told() -> None:
    data = sheets(findings([], DAY), measured())
    rows = {name: list(csv.DictReader(io.StringIO(text, newline=""))) for name, text in data.items()}
    assert rows["prometheus-recoveries.csv"][1] == {"kind": "Recovery", "how": "none", "result": "Failed", "count": "1"}
    (whole,) = (row for row in rows["prometheus-times.csv"] if (row["strategy"], row["part"]) == ("Restart", WHOLE))
    assert (whole["count"], whole["mean_seconds"], whole["upto_1_seconds"], whole["upto_inf_seconds"]) == (
        "3",
        "3.5",
        "0",
        "3",
    )
    assert rows["prometheus-pools.csv"][0]["least_ready"] == "0"
    assert not any(name.startswith("prometheus") for name in sheets(findings([], DAY)))


def test_only_the_series_that_are_meant_are_asked_for() -> None:
    assert selector() == "{}"
    assert selector("fleet", state="ready") == '{namespace="fleet",state="ready"}'
    assert selector("fleet", ["b.c", "a"]) == r'{namespace="fleet",workload=~"a|b\\.c"}'
    assert came("x_total", selector("fleet"), DAY).count('{namespace="fleet"}') == came("x_total", "{}", DAY).count(
        "{}"
    )
