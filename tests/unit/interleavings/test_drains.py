"""A node is cordoned, and drained a while later: a robot whose instance in control is elsewhere has a standby all the time."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.unit.interleavings import simulation
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.invariants import _labels, _living
from tests.unit.interleavings.pods import Luck
from tests.unit.interleavings.robots import NODES
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.simulation import Simulation
from understudy.api import names
from understudy.kube.client import Object

FIRST, RUNS = 700_000, 24
SCENE = Scene(
    "drained", workloads=1, strategies=("hot", "Restart"), standbys=1, weather=(0.0,), troubles=("kubelets_write",)
)

FAILS, CORDONED, DRAINED, OVER = 1.0, 12.0, 27.0, 40.0
"""When what happens, in seconds from the beginning."""


class Drained(Simulation):
    """A run in which a standby takes over, and then the node is emptied where the robot's next one waits."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.emptied = ""
        """The node, from when it is cordoned on; none where the instance in control is there too."""
        self.stood_in = False
        """Whether the standby there was made by the workload's own controller."""
        self.robots.places = self._places

    def _places(self) -> Sequence[str]:
        return [node for node in NODES if node != self.emptied]

    def _plan_trouble(self) -> float:
        super()._plan_trouble()
        self.robots.luck = Luck()  # one that never gets up can't be waited for
        for node in NODES:
            self._write(node, False)
        (robot,) = self.workloads
        self.later(FAILS, lambda: self._break(self._active(robot), "deleted"))
        self.later(CORDONED, self._cordon, robot)
        self.later(DRAINED, lambda: self.robots.drain(self.emptied) if self.emptied else None)
        return OVER

    def _cordon(self, robot: str) -> None:
        standbys = list(self._standbys(robot))
        active = self.robots.running.get(self._active(robot))
        if active is None or len(standbys) != 1 or active.node == self.robots.running[standbys[0]].node:
            return
        self.emptied = self.robots.running[standbys[0]].node
        pods = self.server.items["pods"].values()
        self.stood_in = any(p["metadata"]["uid"] in standbys and names.SOURCE in _labels(p) for p in pods)
        self._write(self.emptied, True)

    def _write(self, node: str, cordoned: bool) -> None:
        metadata = {"name": node, "uid": f"uid-{node}", "generation": 1}
        self.server.write("nodes", ("", node), {"metadata": metadata, "spec": {"unschedulable": cordoned}}, "somebody")

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        (robot,) = self.workloads
        if self.emptied and not any(self._standbys(robot)):
            self._broken(f"{robot} has no standby since {self.emptied} is emptied")

    def _standbys(self, robot: str) -> Iterator[str]:
        """Who could take over at once: their UIDs."""
        for (namespace, _), pod in self.server.items["pods"].items():
            uid = pod["metadata"]["uid"]
            found = self.robots.running.get(uid)
            if namespace != NAMESPACE or not _living(pod) or uid == self._active(robot):
                continue
            if found is not None and found.robot == robot and found.stands_by:
                yield uid


def run(seed: int, *, tracing: bool = False) -> tuple[Outcome, Drained]:
    """The run of a seed."""
    base = simulation.prepared(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        made = Drained(SCENE, seed, base, Path(folder), tracing=tracing)
        try:
            return made.run(), made
        finally:
            made.dispose()


def test_a_standby_exists_at_all_times_during_a_drain() -> None:
    stood_in = 0
    for seed in range(FIRST, FIRST + RUNS):
        outcome, made = run(seed)
        assert not outcome.faults, str(run(seed, tracing=True)[0])
        stood_in += made.stood_in
    assert stood_in > RUNS / 4, "it isn't about nothing"
