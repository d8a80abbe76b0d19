"""Runs with a mux: monitors order a process at the robot, which forwards one instance and may switch by itself.

The real code of the monitor's orders and of what it makes of reports, and of the mux with its control and its journal, runs over a model of
topics, links, writers and disks. What must hold is in mux_invariants.py. The agents' fences, which belong to a reflex too, are not part of
these runs (reflexes.py has them).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from tests.unit.interleavings import gates, mux_processes, simulation
from tests.unit.interleavings.actors import NAMESPACE, Monitor
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.mux_invariants import MuxInvariants
from tests.unit.interleavings.mux_processes import Disk, Mux
from tests.unit.interleavings.mux_robots import MuxRobots
from tests.unit.interleavings.mux_senses import MuxMonitor
from tests.unit.interleavings.mux_topics import Topics
from tests.unit.interleavings.pods import PERIOD
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.simulation import Simulation
from tests.unit.interleavings.troubles import FAILURES, TROUBLES
from understudy.api import moments
from understudy.api.base import seconds
from understudy.api.protocol.mux_messages import Order, Token
from understudy.failover.progress import PodIdentity, beside
from understudy.monitor.act.gate import mux_orders
from understudy.monitor.observe.robot import health_observer
from understudy.mux.control import Control, ordered
from understudy.mux.control_journal import ControlJournal

FIRST = 3_000_000
"""From this seed on runs are with a mux."""

SCENES = (
    Scene("mux", workloads=2, strategies=("hot", "Restart"), standbys=1, muxed=True),
    Scene("mux with a reflex", workloads=2, strategies=("hot", "Restart"), standbys=1, reflex="300ms", muxed=True),
    Scene("mux and claims", workloads=2, strategies=("spare", "Restart"), spares=2, muxed=True),
    Scene(
        "mux with a reflex, two standbys",
        workloads=1,
        strategies=("hot", "Restart"),
        standbys=2,
        reflex="300ms",
        muxed=True,
    ),
    Scene(
        "mux and an instance on board",
        workloads=1,
        strategies=("hot", "Restart"),
        standbys=1,
        muxed=True,
        on_board="1s",
    ),
    Scene(
        "mux with a reflex and an instance on board",
        workloads=1,
        strategies=("hot", "Restart"),
        standbys=1,
        reflex="300ms",
        muxed=True,
        on_board="1s",
    ),
)

ELSEWHERE = frozenset({"node_enforces_late", "node_is_deaf"})
"""What goes wrong only where nodes enforce the gate."""

CHECK_PERIOD = 0.02
"""Seconds between two looks of a monitor at what is forwarded, which are more frequent in the product."""

LOST = 0.15
"""How often a mux that restarts has lost its journal."""


class Nonces:
    """Stands in for the module secrets."""

    def __init__(self, choices: Any) -> None:
        self._choices = choices

    def token_hex(self, size: int) -> str:
        """The next nonce."""
        return f"{self._choices.getrandbits(8 * size):0{2 * size}x}"


class Muxed(Simulation):
    """A run with muxes."""

    causes: Mapping[str, int] = {name: weight for name, weight in TROUBLES.items() if name not in ELSEWHERE} | {
        "mux_restarts": 5,
        "mux_dies_at_a_save": 3,
        "mux_stalls": 4,
        "disk_is_full": 3,
        "monitor_and_mux_part": 5,
        "monitor_is_alone": 4,
        "instance_loses_the_mux": 4,
        "instance_is_unheard": 3,
        "order_is_repeated": 3,
        "driver_fails": 6,
        "several_fail_in_an_outage": 6,
        "robot_is_cut_off": 4,
        "instance_on_board_stops": 3,
        "somebody_asks": 2,
    }

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self._tokens: dict[str, Token] = {}
        self._stopped: set[str] = set()
        """Workloads whose instance on board does not send."""
        super().__init__(*arguments, **more)
        for workload in self.workloads:
            disk = Disk(self._folder / f"mux-{workload}")
            mux = Mux(self.network, self.world, workload, Topics(self.network), disk)
            mux.witness = self.mux_invariants
            self._follow_routes(mux)
            self.mine.muxes[workload] = mux
            if self.scene.on_board:
                self.later(PERIOD * self.choices.random(), self._send_from_on_board, mux)

    def _follow_routes(self, mux: Mux) -> None:
        mux.changed = lambda: self.mine.route(mux.workload)
        mux.commanded = lambda: self.mine.commanded_safely(mux.workload)

    @property
    def mine(self) -> MuxRobots:
        """The robots."""
        return cast(MuxRobots, self.robots)

    @property
    def mux_invariants(self) -> MuxInvariants:
        """The invariants."""
        return cast(MuxInvariants, self.invariants)

    def _make_robots(self) -> Robots:
        return MuxRobots(self.loop, self.server, self.network, self.choices, self.world)

    def _make_invariants(self) -> Invariants:
        return MuxInvariants(
            self.server,
            self.robots,
            broken=self._broken,
            leads=self._leads,
            deadline=seconds(self.scene.reflex) if self.scene.reflex else 0.0,
            after=seconds(self.scene.on_board) if self.scene.on_board else 0.0,
            known=self._known,
        )

    def _known(self, by: str) -> Token:
        """The newest token that a monitor has received."""
        for monitor in self.monitors:
            reports = cast(MuxMonitor, monitor).reports
            if reports is not None and reports.latest is not None:
                name = monitor.process.name
                self._tokens[name] = max(self._tokens.get(name, Token()), reports.latest.report.token)
        return self._tokens.get(by, Token())

    def _make_monitor(self, process: Process, workload: str, journal: Path, pod: PodIdentity) -> Monitor:
        return MuxMonitor(process, self.network, self.mine, workload, journal, self.kill, self._broken, pod=pod)

    def kill(self, process: Process) -> None:
        self._known("")
        workload = next((one.workload for one in self.monitors if one.process is process), "")
        super().kill(process)
        gate = gates.record(self.server, workload)
        left = beside(gate.recovery) if gate is not None else None
        is_continued = left is not None and left.result == "Running"
        if any(one.workload == workload for one in self.monitors) or not is_continued:
            left = None
        self.mux_invariants.killed(process.name, workload, left.id if left is not None else "")

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        yield from super().patches()
        yield mux_orders, "secrets", Nonces(self.choices)
        yield health_observer, "CHECK_PERIOD", CHECK_PERIOD
        yield os, "fsync", mux_processes.sync(self._disk_of, lambda: self.choices.random() < 0.7)

    def _disk_of(self, process: Process) -> tuple[Disk, Any] | None:
        mux = next((one for one in self.mine.muxes.values() if one.process is process), None)
        return (mux.disk, lambda: self._restart(mux)) if mux is not None else None

    def _take_up(self) -> None:
        super()._take_up()
        for workload, mux in self.mine.muxes.items():
            gate, item = gates.record(self.server, workload), self.server.get("robotworkloads", (NAMESPACE, workload))
            created = moments.unix(item["metadata"].get("creationTimestamp")) if item is not None else None
            if gate is not None and created is not None:
                ControlJournal(mux.disk.file).save(ordered(Control(), Order(created, gate.epoch, gate.active)))
            self._start(mux)

    def _start(self, mux: Mux) -> None:
        if mux.process is None:
            name = f"mux-{next(self._incarnations)} of {mux.workload}"
            self.note(f"{name} starts")
            mux.start(name, self._follow)

    def _look_at_drivers(self) -> None:
        super()._look_at_drivers()
        for workload in self.workloads:
            monitors = [cast(MuxMonitor, one) for one in self.monitors if one.workload == workload]
            self.mux_invariants.look(workload, monitors, is_unhindered=self._is_unhindered(workload))

    def _is_unhindered(self, workload: str) -> bool:
        return super()._is_unhindered(workload) and not self.mine.cut and not self.mine.unheard

    def _mistaken(self) -> Iterator[str]:
        yield from super()._mistaken()
        for one in self.monitors:
            status, reason = cast(MuxMonitor, one).condition("GateEnforced")
            if status != "True":
                yield f"{one.process} says GateEnforced={status} ({reason})"

    def run(self) -> Outcome:
        outcome = super().run()
        outcome.muxes = dict(self.mux_invariants.counts)
        return outcome

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def _any_mux(self) -> Mux:
        return self.mine.muxes[self.choices.choice(self.workloads)]

    def _driver(self, workload: str) -> str:
        """The UID of whom the mux forwards, or else of whom the gate names."""
        control = self.mine.muxes[workload].control
        found = [one.uid for one in self.robots.running.values() if control is not None and one.name == control.source]
        return found[-1] if found else self._active(workload)

    def _restart(self, mux: Mux) -> None:
        if mux.process is None:
            return
        self.note(f"{mux.process} is killed")
        mux.end()
        if self.choices.random() < LOST:
            self.note(f"the journal of the mux of {mux.workload} is lost")
            mux.lose_journal()
        self.later(0.1 + self.choices.choice([0.5, 4.0]) * self.choices.random(), self._start, mux)

    def _mux_restarts(self) -> None:
        self._restart(self._any_mux())

    def _mux_dies_at_a_save(self) -> None:
        mux = self._any_mux()
        mux.disk.kills_in = self.choices.randint(0, 5)
        self.later(self.choices.random(), self._break, self._driver(mux.workload), "stops for a while")

    def _mux_stalls(self) -> None:
        mux, lasts = self._any_mux(), self.choices.choice([0.3, 1.0, 6.0]) * self.choices.random()
        if mux.process is not None and not mux.process.stalled:
            self.note(f"{mux.process} gets no processor for {lasts:.2f} s")
            self.loop.stall(mux.process, lasts, self.world)
            mux.changed()
            self.later(lasts + 0.001, mux.changed)

    def _disk_is_full(self) -> None:
        mux, lasts = self._any_mux(), 5 * self.choices.random()
        self.note(f"the disk of the mux of {mux.workload} fails for {lasts:.1f} s")
        mux.disk.is_full = True
        self.later(lasts, setattr, mux.disk, "is_full", False)
        if self.choices.random() < 0.7:
            how = self.choices.choice(FAILURES)
            self.later(lasts * self.choices.random(), lambda: self._break(self._driver(mux.workload), how))

    def _part(self, monitor: Monitor, lasts: float) -> None:
        topics = self.mine.muxes[monitor.workload].topics
        self.note(f"{monitor.process} and the mux do not reach each other for {lasts:.1f} s")
        topics.part(monitor.process)
        self.later(lasts, topics.join, monitor.process)

    def _monitor_and_mux_part(self) -> None:
        if self.monitors:
            monitor, lasts = self.choices.choice(self.monitors), self.choices.choice([1, 6, 20]) * self.choices.random()
            self._part(monitor, lasts)
            if self.choices.random() < 0.6:
                how = self.choices.choice(FAILURES)
                self.later(lasts * self.choices.random(), lambda: self._break(self._driver(monitor.workload), how))

    def _monitor_is_alone(self) -> None:
        """It reaches neither the API server nor any pod nor the mux; another one may be made meanwhile."""
        if not self.monitors:
            return
        monitor, lasts = self.choices.choice(self.monitors), 1 + self.choices.choice([4, 15]) * self.choices.random()
        process = monitor.process
        self._part(monitor, lasts)
        self.note(f"{process} reaches nobody")
        self.network.cut_off.add(process)
        self.later(lasts, self.network.cut_off.discard, process)
        self._unhear([process], lasts)
        if self.choices.random() < 0.5:
            self.later(lasts * self.choices.random(), self._replace_monitor, monitor.workload)

    def _unhear(self, processes: Sequence[Process], lasts: float) -> None:
        """Monitors hear no pod for a while."""
        self.network.set_apart(processes, True)
        for found in self.robots.running.values():
            found.harmed = True
        self.robots.reroute()
        self.later(lasts, self._hear, processes)

    def _hear(self, processes: Sequence[Process]) -> None:
        self.network.set_apart(processes, False)
        self.mine.joined_at = self.robots.now
        self.robots.reroute()

    def _monitor_reaches_no_pod(self) -> None:
        if self.monitors:
            monitor, lasts = self.choices.choice(self.monitors), self.choices.choice([4, 12, 60])
            self.note(f"{monitor.process} reaches no pod for {lasts} s")
            self._unhear([monitor.process], lasts)

    def _cut(self, uid: str, of: set[str], words: str) -> None:
        self._cut_for(uid, of, words, self.choices.choice([0.5, 2.0, 8.0]) * (0.2 + self.choices.random()))

    def _cut_for(self, uid: str, of: set[str], words: str, lasts: float) -> None:
        if (found := self.robots.running.get(uid)) is not None:
            self.note(f"pod {found.name} {words} for {lasts:.2f} s")
            found.harmed = True
            self.mine.set_cut(uid, of, True)
            self.later(lasts, self.mine.set_cut, uid, of, False)

    def _instance_loses_the_mux(self) -> None:
        self._cut(self._driver(self.choices.choice(self.workloads)), self.mine.cut, "does not reach the mux")

    def _instance_is_unheard(self) -> None:
        self._cut(self._driver(self.choices.choice(self.workloads)), self.mine.unheard, "is heard by no monitor")

    def _order_is_repeated(self) -> None:
        """Somebody who recorded orders sends some of them again."""
        topics = self._any_mux().topics
        if topics.sent:
            for _ in range(self.choices.randint(1, 4)):
                self.later(2 * self.choices.random(), topics.repeat, self.choices.choice(list(topics.sent)))

    def _driver_fails(self) -> None:
        self._break(self._driver(self.choices.choice(self.workloads)), self.choices.choice(FAILURES))

    def _several_fail_in_an_outage(self) -> None:
        """Monitors lose the API server, or the mux, or both; and whom the mux forwards fails, one after the other."""
        workload, lasts = self.choices.choice(self.workloads), 2 + 12 * self.choices.random()
        mine = [one for one in self.monitors if one.workload == workload]
        which = self.choices.choice(["api", "mux", "both"])
        for monitor in mine:
            if which != "mux":
                self.note(f"{monitor.process} is cut off from the API server for {lasts:.1f} s")
                self.network.cut_off.add(monitor.process)
                self.later(lasts, self.network.cut_off.discard, monitor.process)
            if which != "api":
                self._part(monitor, lasts)
        for _ in range(self.choices.randint(1, 3)):
            how = self.choices.choice(["stops for a while", "freezes", "crashes", "slows down", "deleted by force"])
            self.later(lasts * self.choices.random(), lambda how=how: self._break(self._driver(workload), how))

    def _send_from_on_board(self, mux: Mux) -> None:
        if mux.workload not in self._stopped:
            mux.arrive_from_on_board()
        self.later(PERIOD, self._send_from_on_board, mux)

    def _instance_on_board_stops(self) -> None:
        workload, lasts = self.choices.choice(self.workloads), 6 * self.choices.random()
        if self.scene.on_board:
            self.note(f"the instance on board of {workload} does not send for {lasts:.1f} s")
            self._stopped.add(workload)
            self.later(lasts, self._stopped.discard, workload)

    def _robot_is_cut_off(self) -> None:
        """Neither the existing instances nor the existing monitors reach the robot, and what drives it fails meanwhile."""
        workload, lasts = self.choices.choice(self.workloads), 1 + 15 * self.choices.random()
        for found in [one for one in self.robots.running.values() if one.robot == workload and not one.ended]:
            self._cut_for(found.uid, self.mine.cut, f"does not reach the mux of {workload}", lasts)
        for monitor in [one for one in self.monitors if one.workload == workload]:
            self._part(monitor, lasts)
        for fail in (self._instance_on_board_stops, lambda: self._restart(self.mine.muxes[workload])):
            if self.choices.random() < 0.4:
                self.later(lasts * self.choices.random(), fail)
        if self.choices.random() < 0.4:
            how = self.choices.choice(FAILURES)
            self.later(lasts * self.choices.random(), lambda: self._break(self._active(workload), how))

    def _plan_trouble(self) -> float:
        lasts = super()._plan_trouble()
        bad = self.choices.choice(self.scene.weather)
        for mux in self.mine.muxes.values():
            mux.topics.loss = 0.05 * bad
        return lasts

    def _end_of_trouble(self) -> None:
        for mux in self.mine.muxes.values():
            mux.topics.loss, mux.disk.is_full, mux.disk.kills_in = 0.0, False, None
            for process in sorted(mux.topics.parted, key=lambda one: one.name):
                mux.topics.join(process)
        self.mine.cut.clear()
        self.mine.unheard.clear()
        self._stopped.clear()
        super()._end_of_trouble()
        self.mine.joined_at = self.robots.now
        self.robots.reroute()


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None, kind: type[Muxed] = Muxed) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also has all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    return simulation.made(kind, scene, seed, simulation.prepared(scene, Muxed), tracing=tracing)
