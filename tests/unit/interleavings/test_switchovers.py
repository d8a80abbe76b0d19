"""Planned switchovers in whatever order: somebody asks for them, or cordons nodes, while all else goes wrong. What holds without
them holds with them.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.unit.interleavings import simulation
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.robots import NODES
from tests.unit.interleavings.scenes import SCENES, Outcome
from tests.unit.interleavings.simulation import Simulation
from understudy.api import names
from understudy.failover.progress import Progress
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord

FIRST, RUNS = 300_000, 36
"""Runs of one test."""


class RequestedSwitchovers(Simulation):
    """A run in which somebody asks for switchovers, now and then while nothing else happens."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self.switched: Counter[str] = Counter()
        """How often the gate was switched as planned, by what for."""
        super().__init__(*arguments, **more)

    def _plan_trouble(self) -> float:
        lasts = super()._plan_trouble()
        for _ in range(self.choices.randint(1, 4)):
            self.later(self.choices.random() * lasts, self._somebody_asks)
        for node in NODES:  # where none is left that isn't cordoned, nothing is moved
            self._cordon(node, False)
        for _ in range(self.choices.randint(0, 2)):
            self.later(self.choices.random() * lasts, self._node_is_cordoned)
        return lasts

    def _node_is_cordoned(self) -> None:
        node = self.choices.choice(NODES)
        self._cordon(node, True)
        self.later(1 + self.choices.random() * 30, self._cordon, node, False)

    def _cordon(self, node: str, so: bool) -> None:
        self.note(f"node {node} is {'cordoned' if so else 'as it was'}")
        metadata = {"name": node, "uid": f"uid-{node}", "generation": 1}
        self.server.write("nodes", ("", node), {"metadata": metadata, "spec": {"unschedulable": so}}, "somebody")

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        if plural != "networkpolicies" or new is None or not (record := GateRecord.of(new)).recovery:
            return
        progress = Progress.model_validate_json(record.recovery)
        kind = progress.switchover
        if kind is None:
            return
        self.switched[kind] += old is not None and GateRecord.of(old).active_uid != record.active_uid
        # The response to a leak may close it when the switchover has ended.
        changed = old is not None and GateRecord.of(old).recovery != record.recovery
        if changed and not record.active and progress.result == "Running":
            self._broken(f"a switchover has closed the gate {new['metadata']['name']}")

    def _mistaken(self) -> Iterator[str]:
        yield from super()._mistaken()
        for (_, name), budget in sorted(self.server.items["poddisruptionbudgets"].items()):
            if not name.endswith("-in-control"):
                continue  # a pool's
            workload = name.removesuffix("-in-control")
            gate = self.server.get("networkpolicies", (NAMESPACE, names.gate(workload)))
            selected = budget["spec"]["selector"]["matchLabels"][names.INSTANCE]
            if gate is not None and GateRecord.of(gate).active != selected:
                yield f"evictions of {selected} wait, which doesn't drive {workload}"
        for (_, name), item in sorted(self.server.items["robotworkloads"].items()):
            asked = (item["metadata"].get("annotations") or {}).get(names.SWITCHOVER)
            # As its monitor has it: what a dead one has written may come late, over what its successor says.
            monitors = [m for m in self.monitors if m.workload == name]
            statuses = [monitor.notices.status.switchover for monitor in monitors if monitor.notices is not None]
            if asked and not any(one is not None and one.handled == asked for one in statuses):
                yield f"{name} was never told what became of {asked!r}"


def run(seed: int, *, tracing: bool = False) -> tuple[Outcome, Counter[str]]:
    """The run of a seed, and how often the gate was switched in it as planned, by what for."""
    scene = SCENES[seed % len(SCENES)]
    base = simulation.prepared(scene)
    with tempfile.TemporaryDirectory() as folder:
        made = RequestedSwitchovers(scene, seed, base, Path(folder), tracing=tracing)
        try:
            return made.run(), made.switched
        finally:
            made.dispose()


def test_the_invariants_hold_with_switchovers() -> None:
    switched: Counter[str] = Counter()
    for seed in range(FIRST, FIRST + RUNS):
        outcome, count = run(seed)
        assert not outcome.faults, str(run(seed, tracing=True)[0])
        switched += count
    assert switched["Failover"], "it isn't about nothing"
    assert switched["Drain"]
