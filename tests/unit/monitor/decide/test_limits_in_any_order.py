"""Budgets that are spent again and again, and storms, in whatever order failures, deaths of monitors and lost requests come: what must
always hold (tests/unit/interleavings) holds, and every robot is driven again in the end.
"""

from __future__ import annotations

import functools
from typing import Any

import pytest

from tests.unit.controller import world
from tests.unit.interleavings import simulation
from understudy.failover.limits.state import ActiveLimit
from understudy.failover.progress import Progress
from understudy.kube.client import Object
from understudy.monitor.decide.budget_spending import BudgetSpending
from understudy.monitor.observe.objects.storm_condition import StormCondition

BUDGET = {"budget": {"recoveries": 1, "within": "20s"}, "healthyDelay": "10s", "cooldown": "1s"}
GUARD = {"stormGuard": {"percent": 40, "workloads": 2, "within": "5s", "holdFor": "15s"}}
RUNS = 20


@pytest.mark.parametrize(("limits", "first"), [(BUDGET, 200_000), (GUARD, 400_000)], ids=["budget", "storm"])
def test_robots_whose_failures_are_held_are_finally_driven(
    monkeypatch: pytest.MonkeyPatch, limits: Object, first: int
) -> None:
    made, report, on = world.policy, BudgetSpending.report_held, StormCondition.on
    held: list[str] = []

    def policy(*arguments: Any, **more: Any) -> Object:
        found = made(*arguments, **more)
        found["spec"]["limits"] = limits
        return found

    def reported(self: BudgetSpending, progress: Progress) -> None:
        held.append(progress.reason)
        report(self, progress)

    def storm(self: StormCondition, now: float) -> ActiveLimit | None:
        if (notice := on(self, now)) is not None:
            held.append(notice.words)
        return notice

    monkeypatch.setattr(world, "policy", policy)
    # What other tests of this process have prepared has another policy, and the other way round.
    monkeypatch.setattr(simulation, "at_rest", functools.cache(simulation.at_rest.__wrapped__))
    monkeypatch.setattr(BudgetSpending, "report_held", reported)
    monkeypatch.setattr(StormCondition, "on", storm)
    for seed in range(first, first + RUNS):
        outcome = simulation.run(seed)
        assert not outcome.faults, str(outcome)
    assert held, "there were some"
