"""A shared pool's template changes again and again, by each strategy, and its size follows what fails, while its pods are claimed,
lost and drained.
"""

from __future__ import annotations

import pytest

from tests.unit.interleavings import simulation
from tests.unit.interleavings.scenes import Scene

STRATEGIES: dict[str, tuple[tuple[str, str | int], ...]] = {
    "replenished": (("type", "OnReplenish"),),
    "some-ready": (("minReady", 1),),
    "none-ready": (("minReady", 0),),
}
TROUBLES = ("one_fails", "all_fail", "template_changes", "pool_is_resized", "node", "operator_dies", "somebody_stalls")
FIRST, RUNS = 200_000, 8


@pytest.mark.parametrize("name", STRATEGIES)
@pytest.mark.parametrize("troubles", [(), TROUBLES], ids=["anything", "updates"])
def test_no_surplus_pod_is_created_or_remains(name: str, troubles: tuple[str, ...]) -> None:
    scene = Scene(
        name, workloads=3, strategies=("spare", "Restart"), spares=2, updates=STRATEGIES[name], troubles=troubles
    )
    for seed in range(FIRST, FIRST + RUNS):
        outcome = simulation.run(seed, scene=scene)
        assert not outcome.faults, str(simulation.run(seed, tracing=True, scene=scene))


def test_a_sized_pool_finally_has_the_computed_number_of_pods() -> None:
    sizing = (
        ("risk", "1%"),
        ("failuresPerRobotHour", 0.5),
        ("refill", "300s"),
        ("history", "1h"),
        ("min", 1),
        ("max", 4),
    )
    troubles = (*(one for one in TROUBLES if one != "pool_is_resized"), "monitor_dies", "somebody_is_cut_off")
    scene = Scene("sized", workloads=3, strategies=("spare", "Restart"), spares=1, sizing=sizing, troubles=troubles)
    for seed in range(FIRST, FIRST + RUNS):
        outcome = simulation.run(seed, scene=scene)
        assert not outcome.faults, str(simulation.run(seed, tracing=True, scene=scene))
