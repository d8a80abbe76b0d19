"""A budget that is spent again and again, in whatever order failures, deaths of monitors and lost requests come: what must always hold
(tests/unit/interleavings) holds, and every robot is driven again once its window has moved on.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller import world
from tests.unit.interleavings import simulation
from understudy.cluster.client import Object
from understudy.mitigation.progress import Progress
from understudy.monitor.supervising import Supervisor

LIMITS = {"budget": {"recoveries": 1, "within": "20s"}, "healthyDelay": "10s", "cooldown": "1s"}
FIRST, RUNS = 200_000, 25


def test_robots_whose_failures_are_held_are_driven_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    made, hold = world.policy, Supervisor._hold
    held: list[Progress] = []

    def policy(*arguments: Any, **more: Any) -> Object:
        found = made(*arguments, **more)
        found["spec"]["limits"] = LIMITS
        return found

    async def noted(self: Supervisor, progress: Progress) -> None:
        await hold(self, progress)
        held.append(progress)

    monkeypatch.setattr(world, "policy", policy)
    monkeypatch.setattr(Supervisor, "_hold", noted)
    for seed in range(FIRST, FIRST + RUNS):
        outcome = simulation.run(seed)
        assert not outcome.faults, str(outcome)
    assert held, "there were some"
