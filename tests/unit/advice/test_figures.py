"""What is known of strategies: what recoveries say, and what was published."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from understudy.advice.strategy_figures import PUBLISHED_CPU, PUBLISHED_SECONDS, Figure, Figures, measured_times
from understudy.api.kinds.robot_workload import Attempt, Parts, Recovery

RESULTS = Path(__file__).parents[3] / "bench" / "results" / "navigation.json"
CONFIGURATIONS = {
    "Executing": "executing",
    "Initialized": "stack-started",
    "Uninitialized": "pod-started",
    "Restart": "restart",
}


def recovery(by: str, seconds: float, **more: Any) -> Recovery:
    parts = Parts(detection=0.5, cluster=seconds / 2, startup=seconds / 4, reinitialization=seconds / 4)
    return Recovery(id="r", reason="gone", **{"result": "Recovered", "strategy": by, "parts": parts, **more})


def test_a_measured_time_is_the_median_after_the_detection():
    found = measured_times([recovery("Fallback/Executing", seconds) for seconds in (0.02, 0.03, 0.9)])
    assert found == {"Executing": Figure(pytest.approx(0.03), "measured 3 times")}


def test_two_recoveries_are_too_few_for_a_measurement():
    assert (
        measured_times([recovery("Restart", 1.0), recovery("Restart", 2.0), recovery("Fallback/Uninitialized", 3.0)])
        == {}
    )


@pytest.mark.parametrize(
    "other",
    [
        {"result": "Failed"},
        {"planned": True},
        {"resumed": True},
        {"parts": None},
        {"strategy": "Fallback/Executing (reflex)"},
        {"attempts": [Attempt(strategy="Fallback/Executing", result="NotVerified")]},
    ],
    ids=lambda other: next(iter(other)),
)
def test_recoveries_without_evidence_about_a_strategy_are_omitted(other):
    assert measured_times([recovery("Restart", 1.0, **other) for _ in range(5)]) == {}


def test_a_strategy_that_was_not_available_took_no_time():
    passed = [Attempt(strategy="Fallback/Executing", result="NotAvailable")]
    assert (
        measured_times([recovery("Restart", 1.0, attempts=passed) for _ in range(3)])["Restart"].source
        == "measured 3 times"
    )


def test_an_unmeasured_time_is_the_published_one_and_marked_as_published():
    known = Figures(measured_seconds={"Restart": Figure(1.5, "measured 4 times")})
    assert (known.seconds("Restart").value, known.seconds("Restart").source) == (1.5, "measured 4 times")
    assert (known.seconds("Executing").value, known.seconds("Executing").source) == (0.05, "published")
    assert known.cpu("Uninitialized") == Figure(0.0)


def test_the_published_figures_are_close_to_those_of_the_last_bench():
    """Near and not the same: a bench that is run again is no reason to choose otherwise."""
    figures = json.loads(RESULTS.read_text())["figures"]

    def mean(configuration: str, what: str) -> float:
        found: float = figures[f"{configuration}: {what}"]["mean"]
        return found

    for way, configuration in CONFIGURATIONS.items():
        parts = (mean(configuration, f"t_{part}") / 1000 for part in ("cluster", "startup", "reinitialization"))
        assert PUBLISHED_SECONDS[way] == pytest.approx(sum(parts), rel=0.5, abs=0.1)
    # One stack at a time runs where the pod is held, and none of its time is spent on starting others.
    alone = mean("pod-started", "mean CPU of stacks")
    for way in ("Executing", "Initialized"):
        more = mean(CONFIGURATIONS[way], "mean CPU of stacks") / alone - 1
        assert PUBLISHED_CPU[way] == pytest.approx(more, abs=0.25)
