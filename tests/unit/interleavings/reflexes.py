"""Runs with a reflex: robots whose readers fall over by themselves, and monitors that follow.

The real code of the monitor's reflex and permits, of the strategies, and of the agents' strengths and fences runs over a
model of readers with exclusive ownership, of pods, and of a network whose nodes can be cut off. What must hold is said in
reflexinvariants.py.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from tests.unit.interleavings import gates, simulation
from tests.unit.interleavings.actors import Monitor
from tests.unit.interleavings.apiserver import EPOCH
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.network import Weather
from tests.unit.interleavings.reflexinvariants import LOOK, ReflexInvariants
from tests.unit.interleavings.reflexrobots import EVERYBODY, ReflexRobots
from tests.unit.interleavings.reflexsenses import ReflexMonitor
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.simulation import Simulation
from tests.unit.interleavings.troubles import TROUBLES
from tests.unit.interleavings.virtual_time import Clock
from understudy.agent import prepare
from understudy.api.kinds.robot_workload import Reflex
from understudy.api.protocol import ownership_strength
from understudy.failover.progress import PodIdentity

FIRST = 1_000_000
"""From this seed on runs are of the reflex."""

SOME = (frozenset({"robot"}), frozenset({"monitor"}), frozenset({"robot", "monitor"}), frozenset({"nodes"}))
"""Whom a node may be cut off from, but for everybody. One that doesn't reach the API server, and does reach its robot, enforces an
old gate for as long: that is a limit of gates.
"""

SCENES = (
    Scene("reflex", workloads=2, strategies=("hot", "Restart"), standbys=1, reflex="300ms"),
    Scene(
        "reflex and claims", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1, reflex="300ms"
    ),
    Scene("reflex, two standbys", workloads=1, strategies=("hot", "Restart"), standbys=2, reflex="300ms"),
)


ELSEWHERE = frozenset(
    {
        "monitor_is_denied",
        "node_enforces_late",
        "node_is_deaf",
        "node_is_forgotten",
        "decision_is_late",
        "clock_is_set",
    }
)
"""What goes wrong only in runs without a reflex: nodes that are cut off, and an API server that refuses things, are among these already."""


class Reflexive(Simulation):
    """A run with a reflex."""

    causes: Mapping[str, int] = {name: weight for name, weight in TROUBLES.items() if name not in ELSEWHERE} | {
        "active_hangs": 7,
        "standby_hangs": 3,
        "node_is_cut_off": 6,
        "node_is_cut_off_from_some": 3,
        "api_server_is_away": 4,
        "monitor_reaches_nobody": 2,
        "robot_restarts": 1,
        "somebody_asks": 2,
    }

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self._away = 0
        super().__init__(*arguments, **more)

    @property
    def mine(self) -> ReflexRobots:
        """The robots."""
        return cast(ReflexRobots, self.robots)

    def _make_robots(self) -> Robots:
        made = ReflexRobots(
            self.loop,
            self.server,
            self.network,
            self.choices,
            self.world,
            folder=self._folder,
            reflex=Reflex(deadline=self.scene.reflex),
        )
        made.agent_reported = self._agent_reported
        return made

    def _make_invariants(self) -> Invariants:
        return ReflexInvariants(
            self.server,
            self.robots,
            broken=self._broken,
            leads=self._leads,
            excused=self._excused,
            says=self._says,
        )

    def _make_monitor(self, process: Process, workload: str, journal: Path, pod: PodIdentity) -> Monitor:
        made = ReflexMonitor(process, self.network, self.mine, workload, journal, self.kill, self._broken, pod=pod)
        invariants = cast(ReflexInvariants, self.invariants)
        made.agents.shut_out = functools.partial(invariants.shut_out, workload)
        return made

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        yield ownership_strength, "BEGIN", EPOCH - 3600.0
        yield prepare, "time", Clock(lambda: self.mine.prepared_at)

    def _agent_reported(self, robot: str) -> None:
        for monitor in self.monitors:
            if monitor.workload == robot and monitor.process.alive:
                self.loop.call_soon(monitor.wakeups.agent_reported, context=monitor.process.context)

    def _follow(self, process: Process, work: object) -> None:
        if self._away:
            self.network.cut_off.add(process)
        super()._follow(process, work)

    def _says(self, robot: str) -> str:
        return "; ".join(cast(ReflexMonitor, m).says("Reflex") for m in self.monitors if m.workload == robot)

    def _excused(self, robot: str) -> bool:
        """Whether a robot's monitor can't be expected to see to it."""
        monitors = [m for m in self.monitors if m.workload == robot]
        well = (
            len(monitors) == 1
            and not monitors[0].process.stalled
            and monitors[0].process not in self.network.cut_off
            and robot not in self.mine.apart
            and not self.mine.cuts
            and not self.network.half_open
            and self.network.weather == Weather()
            and not self.pauses.is_paused(robot)
        )
        return not well or "NothingVerified" in cast(ReflexMonitor, monitors[0]).says("Recovering")

    def _take_up(self) -> None:
        cast(ReflexInvariants, self.invariants).take_up()
        self.mine.take_up()
        self._look_at_robots()

    def run(self) -> Outcome:
        outcome = super().run()
        outcome.reflex = dict(self.mine.counts)
        return outcome

    def _look_at_robots(self) -> None:
        cast(ReflexInvariants, self.invariants).look()
        self.later(LOOK, self._look_at_robots)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def _standby(self, workload: str) -> str:
        """The standby that is let through, or else any."""
        gate = gates.record(self.server, workload)
        if gate is not None and gate.admitted_uid:
            return gate.admitted_uid
        others = [
            uid for uid, r in self.robots.running.items() if r.robot == workload and uid != self._active(workload)
        ]
        return self.choices.choice(sorted(others)) if others else ""

    def _hang(self, uid: str) -> None:
        found = self.robots.running.get(uid)
        if found is not None:
            lasts = self.choices.choice([0.4, 1.0, 6.0]) * (0.2 + self.choices.random())
            self.note(f"pod {found.name}: stands still for {lasts:.2f} s")
            self.mine.hang(uid, lasts)

    def _active_hangs(self) -> None:
        self._hang(self._active(self.choices.choice(self.workloads)))

    def _standby_hangs(self) -> None:
        self._hang(self._standby(self.choices.choice(self.workloads)))

    def _cut(self, parties: frozenset[str], lasts: float) -> None:
        workload = self.choices.choice(self.workloads)
        uid = self._active(workload) if self.choices.random() < 0.7 else self._standby(workload)
        if (found := self.robots.running.get(uid)) is not None:
            self.mine.cut(found.node, parties)
            self.later(lasts, self.mine.join, found.node)

    def _node_is_cut_off(self) -> None:
        self._cut(EVERYBODY, self.choices.choice([0.5, 2.0, 8.0]) * (0.2 + self.choices.random()))

    def _node_is_cut_off_from_some(self) -> None:
        self._cut(self.choices.choice(SOME), 6 * self.choices.random())

    def _api_server_is_away(self) -> None:
        """It refuses everything, or nothing arrives there; and mostly something else happens meanwhile."""
        lasts = 0.5 + 9 * self.choices.random()
        self.choices.choice([self._refuses, self._is_away])(lasts)
        simultaneous = [
            self._one_fails,
            self._active_hangs,
            self._node_is_cut_off,
            self._standby_hangs,
            self._monitor_dies,
        ]
        for _ in range(self.choices.randint(0, 2)):
            self.later(lasts * self.choices.random(), self.choices.choice(simultaneous))

    def _refuses(self, lasts: float) -> None:
        self.note(f"the API server refuses everything for {lasts:.1f} s")
        weather, self.network.weather = self.network.weather, Weather(refused=1.0)
        self.later(lasts, self._is_back, weather)

    def _is_away(self, lasts: float) -> None:
        self.note(f"nobody reaches the API server for {lasts:.1f} s")
        self._away += 1
        self.network.cut_off |= {actor.process for actor in (*self.monitors, *self.operators)}
        self.later(lasts, self._is_reached)

    def _is_back(self, weather: Weather) -> None:
        if not self._calm:
            self.network.weather = weather

    def _is_reached(self) -> None:
        self._away = max(0, self._away - 1)
        if not self._away:
            self.network.cut_off.clear()

    def _monitor_reaches_nobody(self) -> None:
        workload, lasts = self.choices.choice(self.workloads), 6 * self.choices.random()
        self.note(f"the monitors of {workload} reach nobody for {lasts:.1f} s")
        self._set_apart(workload, True)
        self.later(lasts, self._set_apart, workload, False)

    def _set_apart(self, workload: str, so: bool) -> None:
        processes = {monitor.process for monitor in self.monitors if monitor.workload == workload}
        if so:
            self.mine.apart.add(workload)
            self.network.cut_off |= processes
        else:
            self.mine.apart.discard(workload)
            self.network.cut_off -= processes
        self.mine.route(workload)
        self._agent_reported(workload)

    def _robot_restarts(self) -> None:
        workload = self.choices.choice(self.workloads)
        self.note(f"{workload}: the robot's own process is restarted")
        del self.mine.readers[workload]
        self.mine.route(workload)

    def _end_of_trouble(self) -> None:
        self._away = 0
        for node in sorted(self.mine.cuts):
            self.mine.join(node)
        for workload in sorted(self.mine.apart):
            self._set_apart(workload, False)
        super()._end_of_trouble()


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None, kind: type[Reflexive] = Reflexive) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also tells all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    return simulation.made(kind, scene, seed, simulation.prepared(scene, Reflexive), tracing=tracing)
