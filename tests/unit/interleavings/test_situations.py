"""Situations start and end in any order while other failures happen. All invariants hold as without situations, the final standbys
are those of the situation, and no ready standby that the monitor could have used was removed.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.controller import world
from tests.unit.interleavings import senses, simulated_cluster, simulation
from tests.unit.interleavings.actors import NAMESPACE
from tests.unit.interleavings.invariants import Invariants, _labels, _living
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.simulation import Simulation
from understudy.api import names
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.controller.observed import kube_objects
from understudy.kube import claims
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord
from understudy.monitor.observe.robot.context_detection import SituationState

FIRST, RUNS = 500_016, 16

SCENE = Scene("situations", workloads=2, strategies=("spare", "Restart"), spares=1, standbys=1)
CARRYING = "carrying"


class Settled(Invariants):
    """The standbys of a robot are those of its situation."""

    busy: Collection[str] = ()

    def _refers(self, namespace: str, workload: str) -> bool:
        return True  # as there, the one in control isn't its own standby, and neither is what the workload's controller makes

    def _unfilled(self) -> Iterator[str]:
        pods = [pod for pod in self._server.items["pods"].values() if _labels(pod).get(names.POOL) == "hot"]
        most: int = self._server.items["fallbackpools"][(NAMESPACE, "hot")]["spec"]["perWorkload"]
        for _, workload in sorted(self._server.items["robotworkloads"]):
            mine = [pod for pod in pods if _living(pod) and claims.workload_of(_labels(pod)) == workload]
            waiting = [pod for pod in mine if pod["metadata"]["uid"] not in self._in_control()]
            wanted = most if workload in self.busy else 0
            # Where one of a new template never gets up, the one before it stays.
            if len(waiting) != wanted and all(self._stands_by(pod) for pod in waiting):
                yield f"{workload} has {len(waiting)} standbys instead of {wanted}"


class Situated(Simulation):
    """A run in which robots begin to carry something, and end it."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self.counts: Counter[str] = Counter()
        """The result: standbys that were created, released, and that took over."""
        super().__init__(*arguments, **more)
        self.busy: set[str] = set()
        self.robots.busy = self.invariants.busy = self.busy  # type: ignore[attr-defined]

    def _plan_trouble(self) -> float:
        lasts = super()._plan_trouble()
        for _ in range(self.choices.randint(2, 8)):
            self.later(self.choices.random() * (lasts + 2), self._turn, self.choices.choice(self.workloads))
        return lasts

    def _turn(self, workload: str) -> None:
        self.busy ^= {workload}
        self.note(f"{workload} is {CARRYING}" if workload in self.busy else f"{workload} carries nothing any more")

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        if plural == "networkpolicies" and old is not None and new is not None:
            found = self.robots.running.get(uid := GateRecord.of(new).active_uid)
            if found is not None and GateRecord.of(old).active_uid != uid:
                self.counts["took over"] += (
                    _labels(self.server.get("pods", found.place) or {"metadata": {}}).get(names.POOL) == "hot"
                )
        if plural != "pods" or _labels(new or old or {"metadata": {}}).get(names.POOL) != "hot":
            return
        if old is None:
            self.counts["made"] += 1
        elif by.startswith("operator") and _living(old) and (new is None or not _living(new)):
            self.counts["let go"] += 1
            self._let_go(old, by)

    def _let_go(self, pod: Object, by: str) -> None:
        """No standby that could take over is removed while the monitor counts on it, unless there is another one."""
        workload = claims.workload_of(_labels(pod))
        found = self.robots.running.get(pod["metadata"]["uid"])
        configmap = self.server.get("configmaps", (NAMESPACE, names.settings(workload)))
        if found is None or not found.stands_by or configmap is None:
            return
        situation = WorkloadSettings.model_validate_json(configmap["data"]["settings.json"]).situation
        others = [
            one
            for one in self.server.items["pods"].values()
            if _labels(one).get(names.POOL) == "hot"
            and claims.workload_of(_labels(one)) == workload
            and one["metadata"]["uid"] != found.uid
            and kube_objects.ready(one)
        ]
        if situation == CARRYING and not others:
            self._broken(f"{by} lets {found.name} go, by which {workload} is to be recovered")


def run(seed: int, *, tracing: bool = False) -> tuple[Outcome, Counter[str]]:
    """Returns the run of a seed, and the situations in it."""
    base = simulation.prepared(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        made = Situated(SCENE, seed, base, Path(folder), tracing=tracing)
        try:
            return made.run(), made.counts
        finally:
            made.dispose()


@pytest.fixture
def situations(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy that has a situation, and senses that see it."""
    made = world.policy

    def policy(*strategies: str, **more: Any) -> Object:
        found = made(*strategies, **more)
        raised = made("hot", *strategies)["spec"]["strategies"]
        for strategy in raised:
            strategy["verifyWithin"] = "15s" if strategy["type"] == "Restart" else "5s"
        when = {"task": {"action": "/carry"}}
        found["spec"]["situations"] = [{"name": CARRYING, "when": when, "clearAfter": "2s", "strategies": raised}]
        return found

    def observe(self: Any, goals: Collection[str], *, now: float, since: float) -> dict[str, SituationState]:
        return {CARRYING: SituationState(self._workload in getattr(self._robots, "busy", ()), "it is")}

    monkeypatch.setattr(world, "policy", policy)
    monkeypatch.setattr(senses.HealthObserver, "situations", observe, raising=False)
    monkeypatch.setattr(simulated_cluster, "Invariants", Settled)


@pytest.mark.usefixtures("situations")
def test_the_invariants_hold_with_situations() -> None:
    counts: Counter[str] = Counter()
    for seed in range(FIRST, FIRST + RUNS):
        outcome, count = run(seed)
        assert not outcome.faults, str(run(seed, tracing=True)[0])
        counts += count
    assert counts["made"] > RUNS
    assert counts["took over"], "it isn't about nothing"
    assert counts["let go"]
