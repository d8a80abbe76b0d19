"""Planned switchovers in whatever order: they are asked for while all else goes wrong, and what holds without them holds with them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.interleavings import apiserver, simulation
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.apiserver import EPOCH
from tests.unit.interleavings.simulation import SCENES, Outcome, Simulation
from understudy.api import names
from understudy.api.switchovers import request
from understudy.cluster import gates
from understudy.cluster.client import Object
from understudy.mitigation.progress import Progress

BATCH = 12
"""Runs of one test."""


class Asked(Simulation):
    """A run in which somebody asks for switchovers, now and then while nothing else happens."""

    switched = 0

    def _plan_trouble(self) -> float:
        lasts = super()._plan_trouble()
        for _ in range(self.choices.randint(1, 4)):
            self.later(self.choices.random() * lasts, self._somebody_asks)
        return lasts

    def _somebody_asks(self) -> None:
        workload = self.choices.choice(self.workloads)
        asked = request(self.choices.choice(["failover", "failover", "failback"]), EPOCH + self.loop.time())
        self.note(f"somebody asks for a {asked.split()[0]} of {workload}")
        body = {"metadata": {"annotations": {names.SWITCHOVER: asked}}}
        self.server.update(
            "robotworkloads", (NAMESPACE, workload), lambda item: apiserver.merged(item, body), "somebody"
        )

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        if plural != "networkpolicies" or new is None or not (record := gates.read(new)).recovery:
            return
        if Progress.model_validate_json(record.recovery).switchover is None:
            return
        self.switched += old is not None and gates.read(old).active_uid != record.active_uid
        if old is not None and gates.read(old).recovery != record.recovery and not record.active:
            self._broken(f"a switchover has closed the gate {new['metadata']['name']}")

    def _mistaken(self) -> Iterator[str]:
        yield from super()._mistaken()
        for (_, name), item in sorted(self.server.items["robotworkloads"].items()):
            asked = (item["metadata"].get("annotations") or {}).get(names.SWITCHOVER)
            # As its monitor has it: what a dead one has written may come late, over what its successor says.
            monitors = [m.supervisor for m in self.monitors if m.workload == name and m.supervisor is not None]
            said = [monitor._reporter.switchover for monitor in monitors]
            if asked and not any(one is not None and one.handled == asked for one in said):
                yield f"{name} was never told what became of {asked!r}"


def run(seed: int, *, tracing: bool = False, calmly: bool = False) -> tuple[Outcome, int]:
    """The run of a seed, and how often the gate was switched in it as planned; ``calmly`` nothing else goes wrong."""
    scene = SCENES[seed % len(SCENES)]
    base = simulation.prepared(scene)
    with tempfile.TemporaryDirectory() as folder:
        made = Asked(scene, seed, base, Path(folder), tracing=tracing)
        if calmly:
            made.scene = type(scene)(**{**vars(scene), "troubles": ("kubelets_write",), "weather": (0.0,)})
        try:
            return made.run(), made.switched
        finally:
            made.dispose()


@pytest.mark.parametrize("first", range(300000, 300000 + 3 * BATCH, BATCH))
def test_switchovers_change_nothing_of_what_holds(first: int) -> None:
    switched = 0
    for seed in range(first, first + BATCH):
        outcome, count = run(seed)
        assert not outcome.faults, str(run(seed, tracing=True)[0])
        switched += count
    assert switched >= 2, "it isn't about nothing"
