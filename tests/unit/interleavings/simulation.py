"""One run: some robots, what goes wrong around them for a while, and then calm. All of it follows from the seed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.unit.interleavings.initial_objects import create
from tests.unit.interleavings.invariants import leaving
from tests.unit.interleavings.scenes import SCENES, Outcome, Scene
from tests.unit.interleavings.simulated_cluster import Base
from tests.unit.interleavings.troubles import Troubles
from tests.unit.interleavings.undriven import longest
from tests.unit.interleavings.virtual_time import in_virtual_time
from understudy.api.kinds.failure_policy import FailurePolicySpec

REPLICAS = ("a", "b")
"""Of the operator."""
CALM = 300.0
"""Seconds after which all must be well again: the longest pause between two attempts is a minute."""

LOOK = 1.0
"""Seconds between two looks whether it is."""


class Simulation(Troubles):
    """A run under way."""

    def run(self) -> Outcome:
        """Go through it to the end."""
        with in_virtual_time(self):
            if self.loop.time() == 0.0:
                create(self.scene, self.server)
            self._take_up()
            for replica in REPLICAS:
                self.start_operator(replica)
            for workload in self.workloads:
                self.start_monitor(workload, "first")
            if not self._calm:
                self.later(self._plan_trouble() + 2, self._end_of_trouble)
            self._look(0, None)
            with _uncollected():
                self.loop.run(lambda: not self._over)
        invariants, outcome = self.invariants, self.outcome
        outcome.steps, outcome.seconds = self.loop.steps, self.loop.time()
        outcome.claims, outcome.commits, outcome.creations = (
            invariants.claims,
            invariants.commits,
            invariants.creations,
        )
        outcome.requests = self.network.outcomes
        return outcome

    def _take_up(self) -> None:
        """Go on with what there is when a run begins."""
        return

    def _look(self, well: int, calm_since: float | None) -> None:
        """Once it's calm, see whether all is well, and stays so."""
        self._look_at_drivers()
        if self._calm:
            calm_since = self.loop.time() if calm_since is None else calm_since
            unrest = [*self.invariants.unrest(), *self._mistaken()]
            well = well + 1 if not unrest else 0
            if well >= 3:
                self._over = True
                return
            if self.loop.time() - calm_since >= CALM:
                self._broken(f"after {CALM:.0f} s of calm: {'; '.join(unrest)}")
                return
        self.later(LOOK, self._look, well, calm_since)

    def _look_at_drivers(self) -> None:
        """Compare what robots hear with what their monitors say."""
        for monitor in self.monitors:
            monitor.note_hindrance()
        for workload in self.invariants.drivers.doubly:
            says = [one for m in self.monitors if m.workload == workload and (one := m.says()) is not None]
            self.invariants.drivers.look(workload, says)
        if not self.scene.reflex or self.scene.muxed:  # the others have a closer look (reflexinvariants.py)
            for workload in self.workloads:
                able = self._able(workload) if self._is_unhindered(workload) else []
                self.invariants.undriven.look(workload, able, self._longest)

    @functools.cached_property
    def _longest(self) -> float:
        (policy,) = self.server.items["failurepolicies"].values()
        return longest(FailurePolicySpec.model_validate(policy["spec"]))

    def _is_unhindered(self, workload: str) -> bool:
        """Whether a workload has one monitor, which can do all that it should."""
        monitors, network = [m for m in self.monitors if m.workload == workload], self.network
        return (
            len(monitors) == 1
            and not monitors[0].is_hindered
            and not self.pauses.is_paused(workload)
            and not (network.cut_off or network.apart or network.half_open or self._stalled or self.robots.nodes.lags)
        )

    def _able(self, workload: str) -> list[str]:
        """The instances that could drive a robot; empty if somebody does."""
        mine = [found for found in self.robots.running.values() if found.robot == workload and found.exists]
        if any(found.through for found in mine):
            return []
        pods = {pod["metadata"]["uid"]: pod for pod in self.server.items["pods"].values()}
        return [r.name for r in mine if r.stands_by and r.uid in pods and not leaving(pods[r.uid])]

    def _mistaken(self) -> Iterator[str]:
        """What processes take to be so, and isn't."""
        for monitor in self.monitors:
            yield from monitor.mistaken(self.server)
        for operator in self.operators:
            yield from operator.mistaken(self.server)

    def base(self) -> Base:
        """What other runs may begin from."""
        running = {uid: found for uid, found in self.robots.running.items() if not found.ended}
        return Base(self.server.restored(lambda: 0.0), running, self.robots.let_through, self.loop.time())

    def dispose(self) -> None:
        """Let go of everything."""
        self._disposed, self.tracing = True, False
        self.loop.surprised = lambda process, error, message: None
        self.loop.dispose()


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Cyclic garbage is collected once, at the end: an error in it that nobody retrieved is then reported, and always at the same time."""
    gc.disable()
    try:
        yield
        gc.collect(1)
    finally:
        gc.enable()


def prepared(scene: Scene, kind: type[Simulation] = Simulation) -> Base:
    """The cluster of a scene at rest. It is made once, and many runs begin from it."""
    return at_rest(dataclasses.replace(scene, troubles=(), weather=()), kind)


@functools.cache
def at_rest(scene: Scene, kind: type[Simulation]) -> Base:
    """The cluster of a scene without troubles, once nothing changes any more."""
    with tempfile.TemporaryDirectory() as folder:
        simulation = kind(scene, 0, None, Path(folder))
        try:
            outcome = simulation.run()
            assert not outcome.faults, str(outcome)
            return simulation.base()
        finally:
            simulation.dispose()


def made(kind: type[Simulation], scene: Scene, seed: int, base: Base, *, tracing: bool) -> Outcome:
    """Make a run of this kind, from its beginning to its end."""
    with tempfile.TemporaryDirectory() as folder:
        simulation = kind(scene, seed, base, Path(folder), tracing=tracing)
        try:
            return simulation.run()
        finally:
            simulation.dispose()


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also tells all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    return made(Simulation, scene, seed, prepared(scene), tracing=tracing)
