"""One run: some robots, what goes wrong around them for a while, and then calm. All of it follows from the seed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import logging
import random
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from tests.unit.controller import world
from tests.unit.interleavings import apiserver
from tests.unit.interleavings.actors import LEASE, NAMESPACE, Monitor, OperatorProcess
from tests.unit.interleavings.apiserver import EPOCH, ApiServer
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.network import Network, Weather
from tests.unit.interleavings.robots import NODES, REFERRED, Luck, Robots, Running
from tests.unit.interleavings.scheduling import Killed, Process, VirtualLoop, current
from understudy.api import conditions, names
from understudy.api.kinds.switchover_spec import request
from understudy.controller.observed import kube_objects
from understudy.failover import progress
from understudy.kube import apply, leader_election
from understudy.kube.client import Object
from understudy.kube.gates.base import GateRecord
from understudy.monitor import loop as supervising

REPLICAS = ("a", "b")
"""Of the operator."""

TROUBLE = (4.0, 14.0)
"""Seconds, at least and at most, for which things go wrong."""

CALM = 300.0
"""Seconds after which all must be well again: the longest pause between two attempts is a minute."""

LOOK = 1.0
"""Seconds between two looks whether it is."""

NOTICES = 0.1
"""Seconds in which an operator that gets a processor again notices that another one leads."""

ROBOTS = "192.0.2.1/32"
"""Where robots with a reflex are: outside of the cluster."""

TICK = 1.0
"""Seconds between a monitor's looks while nothing wakes it. The simulated senses wake it whenever what they say changes."""


@dataclass(frozen=True)
class Scene:
    """What there is: workloads, and the pools that their policy names."""

    name: str
    workloads: int
    strategies: tuple[str, ...]
    spares: int = 0
    standbys: int = 0
    initializes: bool = False
    """Whether standbys wait initialized, and not executing."""
    activates: bool = False
    """Whether an application has to be brought up by a procedure before it sends."""
    refers: str = ""
    """The kind of what workloads refer to, where they have no template."""
    updates: tuple[tuple[str, str | int], ...] = ()
    """The updateStrategy of the shared pool; none where it is empty."""
    sizing: tuple[tuple[str, str | int | float], ...] = ()
    """The sizing of the shared pool, instead of so many spares."""
    troubles: tuple[str, ...] = ()
    """All that goes wrong with processes and pods; everything, where nothing is named."""
    weather: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 3.0)
    """How bad the network may be."""
    reflex: str = ""
    """The deadline of the robots' readers; no reflex where it is empty."""


SCENES = (
    Scene("shared", workloads=3, strategies=("spare", "Restart"), spares=2),
    Scene("scarce", workloads=2, strategies=("spare", "Restart"), spares=1),
    Scene("executing", workloads=2, strategies=("hot", "Restart"), standbys=1),
    Scene("initialized", workloads=2, strategies=("hot", "Restart"), standbys=1, initializes=True),
    Scene("referred", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1, refers="Deployment"),
    Scene(
        "procedures",
        workloads=2,
        strategies=("hot", "spare", "Restart"),
        spares=1,
        standbys=1,
        initializes=True,
        activates=True,
    ),
    Scene("stateful", workloads=2, strategies=("hot", "Restart"), standbys=1, refers="StatefulSet"),
    Scene("both", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1),
)


TROUBLES = {
    "one_fails": 6,
    "all_fail": 3,
    "understudy_fails": 3,
    "monitor_dies": 4,
    "monitor_dies_at_a_step": 5,
    "second_monitor": 2,
    "operator_dies": 3,
    "operator_is_ended": 1,
    "somebody_stalls": 3,
    "somebody_is_cut_off": 2,
    "monitor_is_denied": 2,
    "watch_falls_silent": 2,
    "kubelets_write": 4,
    "pool_is_resized": 3,
    "template_changes": 2,
    "something_is_deleted": 1,
    "node": 1,
}
"""What goes wrong, and how often in comparison."""


@dataclass
class Outcome:
    """The result of a run."""

    seed: int
    scene: str
    faults: list[str] = field(default_factory=list)
    """What didn't hold; the first one is what matters."""
    trace: list[str] = field(default_factory=list)
    steps: int = 0
    seconds: float = 0.0
    """Of virtual time."""
    claims: int = 0
    commits: int = 0
    creations: int = 0
    requests: dict[str, int] = field(default_factory=dict)
    reflex: dict[str, int] = field(default_factory=dict)
    """Its result; None if there is none."""

    def __str__(self) -> str:
        told = "\n".join([*self.trace, *(f"DOES NOT HOLD: {fault}" for fault in self.faults)])
        return f"seed {self.seed} ({self.scene}), {self.steps} steps, {self.seconds:.1f} s\n{told}"


@dataclass
class Base:
    """A cluster at rest, from which runs begin."""

    server: ApiServer
    running: dict[str, Running]
    let_through: dict[str, tuple[str, ...]]
    time: float


class Simulation:
    """A run under way."""

    causes: Mapping[str, int] = TROUBLES
    """What may go wrong, and how often in comparison."""

    def __init__(self, scene: Scene, seed: int, base: Base | None, folder: Path, *, tracing: bool = False) -> None:
        self.scene, self.choices = scene, random.Random(f"{scene.name}/{seed}")
        self.outcome = Outcome(seed, scene.name)
        self._folder, self._tracing = folder, tracing
        self.loop = VirtualLoop(self.choices)
        self.loop.surprised = self._surprised
        self.world = self.loop.process("world")
        clock: Callable[[], float] = lambda: EPOCH + self.loop.time()  # noqa: E731
        self.server = base.server.restored(clock) if base else ApiServer(clock)
        self.network = Network(self.loop, self.server, self.choices, self.world)
        self.robots = self._make_robots()
        if base is not None:
            self.loop._now = base.time
            self.robots.running = {uid: dataclasses.replace(found) for uid, found in base.running.items()}
            self.robots.let_through = dict(base.let_through)
            self.robots._addresses = len(base.running) * 10
        self.robots.changed = self._heard
        self.invariants = self._make_invariants()
        self.server.changed = self._written
        self.network.noted = self.robots.noted = self.note
        self.network.sending = self._sends
        self._names = itertools.count(1 if base is None else 1001)
        self._incarnations = itertools.count(1)
        self.monitors: list[Monitor] = []
        self.operators: list[OperatorProcess] = []
        self._stalled: set[Process] = set()
        self._journals: dict[str, str] = {}
        self._calm = base is None
        self._over = self._disposed = False
        self._ids = itertools.count(1)

    # -- what it consists of ----------------------------------------------------------------------------------------

    def _make_robots(self) -> Robots:
        return Robots(self.loop, self.server, self.network, self.choices, self.world, activated=self.scene.activates)

    def _make_invariants(self) -> Invariants:
        return Invariants(self.server, self.robots, broken=self._broken, leads=self._leads)

    def _make_monitor(self, process: Process, workload: str, journal: Path) -> Monitor:
        return Monitor(
            process,
            self.network,
            self.robots,
            workload,
            journal,
            self.kill,
            self._broken,
            initializes=self.scene.initializes,
        )

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        """What else has to be so for the time of the run: targets, attributes and their values."""
        yield from ()

    @property
    def workloads(self) -> list[str]:
        return [f"robot-{number}" for number in range(1, self.scene.workloads + 1)]

    def note(self, text: str) -> None:
        """A line of the trace."""
        if self._tracing:
            self.outcome.trace.append(f"{self.loop.time():9.4f} {text}")

    def _broken(self, text: str) -> None:
        if self._disposed:
            return
        self.outcome.faults.append(f"at {self.loop.time():.4f} s: {text}")
        self._over = True

    def _leader(self) -> str:
        """Returns the replica that leads; empty if none does."""
        lease = self.server.get("leases", (NAMESPACE, LEASE))
        found: str = lease["spec"]["holderIdentity"] if lease is not None else ""
        return found

    def _leads(self, name: str) -> bool:
        """Returns whether the operator of that name leads and is alive."""
        return any(o.process.name == name and o.replica == self._leader() for o in self.operators)

    def _sends(self, process: Process, method: str, path: str) -> None:
        """An operator writes only while no other one leads. One that has just got no processor for long may be about to."""
        operator = next((o for o in self.operators if o.process is process), None)
        if operator is None or method == "GET" or "/leases" in path or process in self._stalled:
            return
        if (leader := self._leader()) not in ("", operator.replica):
            self._broken(f"{process} sends {method} {path} while {leader} leads")

    def _surprised(self, process: Process | None, error: BaseException | None, message: str) -> None:
        if not isinstance(error, Killed) and (process is None or process.alive):
            self._broken(f"{process}: {message}: {error!r}")

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        self.network.written(plural)
        self.robots.see(plural, old, new)
        self.invariants.see(plural, old, new, by)
        if self._tracing and plural == "pods" and (item := new or old) is not None:
            phase = (item.get("status") or {}).get("phase", "Pending")
            told = "gone" if new is None else "leaving" if "deletionTimestamp" in item["metadata"] else phase
            self.note(f"  pod {item['metadata']['name']} {told}, by {by}")

    def _heard(self, robot: str) -> None:
        self.invariants.routed(robot)
        for monitor in self.monitors:
            if monitor.workload == robot and monitor.process.alive:
                self.loop.call_soon(monitor.wake, context=monitor.process.context)

    # -- processes --------------------------------------------------------------------------------------------------

    def start_operator(self, replica: str) -> None:
        """A replica of the operator, which expects nothing."""
        process = self.loop.process(f"operator-{next(self._incarnations)} ({replica})")
        operator = OperatorProcess(process, self.network, replica, self._names, self.choices, self.kill)
        self.operators.append(operator)
        self.note(f"{process} starts")
        self._follow(process, operator.run())

    def start_monitor(self, workload: str, journal: str) -> None:
        """A new monitor; the journal is of the node where it runs."""
        process = self.loop.process(f"monitor-{next(self._incarnations)} of {workload}")
        file = self._folder / f"{self.outcome.seed}-{workload}-{journal}.json"
        monitor = self._make_monitor(process, workload, file)
        monitor.agents.started = lambda instance: self.invariants.started(
            workload, instance.uid, (NAMESPACE, instance.name)
        )
        self.monitors.append(monitor)
        self._journals[process.name] = journal
        self.note(f"{process} starts")
        self._follow(process, monitor.run())

    def _follow(self, process: Process, work: object) -> None:
        task = self.loop.start(process, work)  # type: ignore[arg-type]

        def ended(done: object) -> None:
            error = task.exception() if not task.cancelled() else None
            if process.alive and not isinstance(error, Killed):
                self._broken(f"{process} ended by itself: {error!r}")

        task.add_done_callback(ended, context=self.world.context)

    def kill(self, process: Process) -> None:
        """As SIGKILL does; a kubelet starts it again."""
        if not process.alive:
            return
        self.note(f"{process} is killed")
        process.kill()
        for operator in [o for o in self.operators if o.process is process]:
            self.operators.remove(operator)
            self.later(self.choices.random() * 2, self.start_operator, operator.replica)
            return
        monitor = next(m for m in self.monitors if m.process is process)
        self.monitors.remove(monitor)
        if not any(m.workload == monitor.workload for m in self.monitors):
            moved = self.choices.random() < 0.25
            journal = f"other-{next(self._ids)}" if moved else self._journals[process.name]
            if moved:
                self.note(f"the next monitor of {monitor.workload} starts elsewhere, its journal is lost")
            self.later(0.1 + self.choices.random() * 2, self._start_again, monitor.workload, journal)

    def _start_again(self, workload: str, journal: str) -> None:
        # Meanwhile its Deployment may have made another one.
        if not self._calm or not any(monitor.workload == workload for monitor in self.monitors):
            self.start_monitor(workload, journal)

    def later(self, seconds: float, work: Callable[..., object], *args: object) -> None:
        """Do something in the world after so many seconds."""
        self.loop.call_later(seconds, work, *args, context=self.world.context)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def _plan_trouble(self) -> float:
        """Have things go wrong for a while; until when."""
        choices = self.choices
        bad = choices.choice(self.scene.weather)
        # Not before the operator has listed everything, which it does again and again where any of it fails.
        self.later(0.5, setattr, self.network, "weather", Weather.of(bad))
        failing = choices.choice([0.0, 0.2, 0.5])
        self.robots.luck = Luck(broken=choices.choice([0.0, 0.0, 0.1, 0.3]), failing=failing)
        self.note(f"weather {bad}, {self.robots.luck}")
        lasts = TROUBLE[0] + (TROUBLE[1] - TROUBLE[0]) * choices.random()
        causes = self.causes
        troubles = {name: weight for name, weight in causes.items() if name in (self.scene.troubles or causes)}
        for name in choices.choices(list(troubles), list(troubles.values()), k=choices.randint(2, 9)):
            self.later(1 + choices.random() * lasts, getattr(self, f"_{name}"))
        return lasts

    def _active(self, workload: str) -> str:
        gate = self.server.get("networkpolicies", (NAMESPACE, names.gate(workload)))
        return GateRecord.of(gate).active_uid if gate is not None else ""

    def _break(self, uid: str, how: str) -> None:
        found = self.robots.running.get(uid)
        if found is None or not found.exists:
            return
        self.note(f"pod {found.name}: {how}")
        pod = self.server.get("pods", found.place)
        if how in ("deleted", "deleted by force"):
            if pod is not None and pod["metadata"]["uid"] == uid:
                self.robots.delete(pod, by="somebody", force=how != "deleted")
        else:
            {"freezes": self.robots.freeze, "crashes": self.robots.crash, "fails": self.robots.fail}[how](uid)
            if found.broken and uid in {self._active(workload) for workload in self.workloads}:
                self.invariants.failed[uid] = self.robots.now

    def _one_fails(self) -> None:
        how = self.choices.choice(["freezes", "crashes", "fails", "deleted", "deleted by force"])
        self._break(self._active(self.choices.choice(self.workloads)), how)

    def _all_fail(self) -> None:
        how = self.choices.choice(["freezes", "deleted"])
        for workload in self.workloads:
            self._break(self._active(workload), how)

    def _understudy_fails(self) -> None:
        in_control = {self._active(workload) for workload in self.workloads}
        others = [uid for uid, found in self.robots.running.items() if uid not in in_control and found.exists]
        if others:
            how = self.choices.choice(["freezes", "fails", "deleted", "deleted by force"])
            self._break(self.choices.choice(sorted(others)), how)

    def _monitor_dies(self) -> None:
        if self.monitors:
            self.kill(self.choices.choice(self.monitors).process)

    def _monitor_dies_at_a_step(self) -> None:
        if self.monitors:
            monitor = self.choices.choice(self.monitors)
            monitor.fuse.left = self.choices.randint(0, 12)
            self._break(self._active(monitor.workload), self.choices.choice(["freezes", "deleted"]))

    def _second_monitor(self) -> None:
        """As when a node is lost with a monitor that lives on: its Deployment makes another one."""
        workload = self.choices.choice(self.workloads)
        old = next((m for m in self.monitors if m.workload == workload), None)
        self.start_monitor(workload, f"other-{next(self._ids)}")
        if old is not None:
            self.later(self.choices.random() * 8, self.kill, old.process)

    def _operator_dies(self) -> None:
        if self.operators:
            self.kill(self.choices.choice(self.operators).process)

    def _operator_is_ended(self) -> None:
        """End the leading operator as an upgrade does: it gives up its leadership, and the other one acts immediately."""
        if self.operators:
            operator = self.choices.choice(self.operators)
            self.note(f"{operator.process} is to end")
            self.loop.call_soon(operator.end, context=operator.process.context)

    def _anybody(self) -> Process | None:
        found = [actor.process for actor in (*self.monitors, *self.operators)]
        return self.choices.choice(found) if found else None

    def _somebody_stalls(self) -> None:
        if (process := self._anybody()) is None:
            return
        # An operator for so long that the other one takes over, and that one has yet to notice.
        seconds = self.choices.random() * (8 if any(o.process is process for o in self.operators) else 3)
        self.note(f"{process} gets no processor for {seconds:.1f} s")
        self._stalled.add(process)
        self.later(seconds + NOTICES, self._stalled.discard, process)
        self.loop.stall(process, seconds, self.world)

    def _somebody_is_cut_off(self) -> None:
        if (process := self._anybody()) is None:
            return
        seconds = self.choices.random() * 12
        self.note(f"{process} is cut off for {seconds:.1f} s")
        self.network.cut_off.add(process)
        self.later(seconds, self.network.cut_off.discard, process)

    def _monitor_is_denied(self) -> None:
        """The API server denies what it is asked for, which nobody asks for again by themselves: what is under way stops there."""
        if not self.monitors:
            return
        process, seconds = self.choices.choice(self.monitors).process, 1 + self.choices.random() * 8
        self.note(f"{process} is denied every second write for {seconds:.1f} s")
        self.network.denied.add(process)
        self.later(seconds, self.network.denied.discard, process)

    def _watch_falls_silent(self) -> None:
        if self.operators:
            operator = self.choices.choice(self.operators)
            plural = self.choices.choice(["pods", "networkpolicies", "robotworkloads", "fallbackpools"])
            self.note(f"{operator.process}: the watch of {plural} falls silent")
            operator.silent.add(plural)

    def _somebody_asks(self) -> None:
        """For a switchover."""
        workload = self.choices.choice(self.workloads)
        asked = request(self.choices.choice(["failover", "failover", "failback"]), EPOCH + self.loop.time())
        self.note(f"somebody asks for a {asked.split()[0]} of {workload}")
        body = {"metadata": {"annotations": {names.SWITCHOVER: asked}}}
        self.server.update(
            "robotworkloads", (NAMESPACE, workload), lambda item: apiserver.merged(item, body), "somebody"
        )

    def _kubelets_write(self) -> None:
        for uid in sorted(self.robots.running):
            self.later(self.choices.random(), self.robots.heartbeat, uid)

    def _pool_is_resized(self) -> None:
        """By somebody: free pods are deleted while they may be claimed."""
        place, item = self.choices.choice(sorted(self.server.items["fallbackpools"].items()))
        field_, sizes = ("replicas", (0, 1, 2, 3)) if "replicas" in item["spec"] else ("perWorkload", (1, 2))
        size = self.choices.choice(sizes)
        self.note(f"pool {place[1]} is to have {size} pods")
        self.server.update(
            "fallbackpools", place, lambda pool: apiserver.merged(pool, {"spec": {field_: size}}), "somebody"
        )

    def _template_changes(self) -> None:
        """Somebody gives a pool or a workload another image: its pods are replaced while they may be needed."""
        found = [
            (plural, place)
            for plural in ("fallbackpools", "robotworkloads")
            for place, item in sorted(self.server.items[plural].items())
            if "template" in item["spec"]
        ]
        if not found:
            return
        plural, place = self.choices.choice(found)
        image = f"app:{next(self._ids) + 1}"
        self.note(f"{plural} {place[1]} is to run {image}")

        def change(item: Object) -> Object:
            (container,) = item["spec"]["template"]["spec"]["containers"]
            containers = [{**container, "image": image}]
            return apiserver.merged(item, {"spec": {"template": {"spec": {"containers": containers}}}})

        self.server.update(plural, place, change, "somebody")

    def _something_is_deleted(self) -> None:
        """By somebody: what the operator makes again."""
        found = [
            (plural, place)
            for plural in ("networkpolicies", "replicasets", "configmaps")
            for place, item in sorted(self.server.items[plural].items())
            if kube_objects.MANAGED_BY.items() <= kube_objects.labels(item).items()
        ]
        plural, place = self.choices.choice(found)
        self.note(f"{plural} {place[1]}: deleted by somebody")
        self.server.write(plural, place, None, "somebody")
        if place[1].endswith("-gate"):
            self.invariants.failed.clear()  # with its gate goes the record of what has failed
        for pod_place, pod in sorted(self.server.items["pods"].items()):
            owner = apply.controller_of(pod)
            if (
                plural == "replicasets"
                and owner is not None
                and (owner["kind"], owner["name"]) == ("ReplicaSet", place[1])
            ):
                self.robots.delete(pod, by=f"the garbage collector, of {pod_place[1]}")

    def _node(self) -> None:
        node = self.choices.choice(NODES)
        if self.choices.random() < 0.5:
            self.note(f"node {node} is drained")
            self.robots.drain(node)
        else:
            self.note(f"node {node} is lost")
            self.robots.lose(node)

    def _end_of_trouble(self) -> None:
        self.note("from here on nothing goes wrong any more")
        self.network.weather, self.robots.luck = Weather(), Luck(slow=0.0)
        self.network.cut_off.clear()
        self.network.denied.clear()
        for monitor in self.monitors:
            monitor.fuse.left = None
        # Of two monitors of one workload its Deployment ends the older one.
        for workload in self.workloads:
            for monitor in [m for m in self.monitors if m.workload == workload][:-1]:
                self.kill(monitor.process)
        self._calm = True

    # -- running ----------------------------------------------------------------------------------------------------

    def run(self) -> Outcome:
        """Go through it to the end."""
        with _in_virtual_time(self):
            if self.loop.time() == 0.0:
                self._create()
            self._take_up()
            for replica in REPLICAS:
                self.start_operator(replica)
            for workload in self.workloads:
                self.start_monitor(workload, "first")
            if not self._calm:
                self.later(self._plan_trouble() + 2, self._end_of_trouble)
            self._look(0, None)
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

    def _mistaken(self) -> Iterator[str]:
        """What processes take to be so, and isn't."""
        for monitor in self.monitors:
            yield from monitor.mistaken(self.server)
        for operator in self.operators:
            yield from operator.mistaken(self.server)

    def _create(self) -> None:
        scene = self.scene
        items: list[Object] = [world.policy(*scene.strategies)]
        strategies = items[0]["spec"]["strategies"]
        for strategy in strategies:
            strategy["verifyWithin"] = "15s" if strategy["type"] == "Restart" else "5s"
        items[0]["spec"]["monitoring"]["startupGrace"] = "6s"
        if scene.spares:
            updates = {"updateStrategy": dict(scene.updates)} if scene.updates else {}
            pool = world.spare(replicas=scene.spares, **updates)
            if scene.sizing:
                del pool["spec"]["replicas"]
                pool["spec"]["sizing"] = dict(scene.sizing)
            items.append(pool)
        if scene.standbys:
            initialization = {"initialization": {"yaml": {"wait_for": {"node": "/localization"}}}}
            more = {"readiness": "Initialized", **initialization} if scene.initializes else {}
            items.append(world.hot(per_workload=scene.standbys, **more))
        for name in self.workloads:
            more = {"workloadRef": {"kind": scene.refers, "name": f"app-{name}"}} if scene.refers else {}
            if scene.reflex:
                more["gate"] = {"reflex": {"deadline": scene.reflex}, "robots": [ROBOTS]}
            if scene.activates:
                more["bringUp"] = {"yaml": {"wait_for": {"node": "/controller"}}}
            items.append(world.workload(name, ros={"discovery": {"mode": "Multicast"}}, **more))
            if scene.refers:
                self._deploy(name)
        plurals = {
            "FailurePolicy": "failurepolicies",
            "FallbackPool": "fallbackpools",
            "RobotWorkload": "robotworkloads",
        }
        for item in items:
            metadata = {**item["metadata"], "namespace": NAMESPACE, "generation": 1}
            self.server.write(
                plurals[item["kind"]], (NAMESPACE, metadata["name"]), {**item, "metadata": metadata}, "somebody"
            )

    def _deploy(self, workload: str) -> None:
        """A Deployment that somebody has, and its ReplicaSet; or a StatefulSet."""
        name, kind = f"app-{workload}", self.scene.refers
        labels = {REFERRED: workload}
        template = {"metadata": {"labels": {**labels, "pod-template-hash": "1"}}, "spec": world.TEMPLATE["spec"]}
        metadata = {"name": name, "namespace": NAMESPACE, "uid": f"uid-{name}", "generation": 1}
        spec = {"replicas": 1, "selector": {"matchLabels": labels}, "template": template}
        made = {"apiVersion": "apps/v1", "kind": kind, "metadata": metadata, "spec": spec}
        self.server.write(f"{kind.lower()}s", (NAMESPACE, name), made, "somebody")
        if kind != "Deployment":
            return
        owner = {"apiVersion": "apps/v1", "kind": "Deployment", "name": name, "uid": f"uid-{name}", "controller": True}
        metadata = {
            **metadata,
            "name": f"{name}-1",
            "uid": f"uid-{name}-1",
            "labels": labels,
            "ownerReferences": [owner],
        }
        made = {"apiVersion": "apps/v1", "kind": "ReplicaSet", "metadata": metadata, "spec": spec}
        self.server.write("replicasets", (NAMESPACE, f"{name}-1"), made, "somebody")

    def base(self) -> Base:
        """What other runs may begin from."""
        running = {uid: found for uid, found in self.robots.running.items() if not found.ended}
        return Base(self.server.restored(lambda: 0.0), running, self.robots.let_through, self.loop.time())

    def dispose(self) -> None:
        """Let go of everything."""
        self._disposed, self._tracing = True, False
        self.loop.surprised = lambda process, error, message: None
        self.loop.dispose()


@contextlib.contextmanager
def _in_virtual_time(simulation: Simulation) -> Iterator[None]:
    loop, choices = simulation.loop, simulation.choices
    with contextlib.ExitStack() as stack:
        for target, attribute, value in (
            (time, "time", lambda: EPOCH + loop.clock()),
            (time, "monotonic", loop.clock),
            # Only there: trees have identifiers too, and are remembered from one run to the next.
            (progress, "uuid", SimpleNamespace(uuid4=lambda: uuid.UUID(int=choices.getrandbits(128)))),
            (
                conditions,
                "datetime",
                SimpleNamespace(now=lambda zone: datetime.fromtimestamp(EPOCH + loop.time(), zone)),
            ),
            (leader_election, "_now", lambda: f"{loop.time():.6f}"),
            (supervising, "TICK", TICK),
            *simulation.patches(),
        ):
            stack.enter_context(mock.patch.object(target, attribute, value))
        stack.enter_context(_logging(simulation))
        yield


@contextlib.contextmanager
def _logging(simulation: Simulation) -> Iterator[None]:
    """What the code logs belongs to the trace; without one nothing is logged."""
    logger = logging.getLogger("understudy")
    level, propagates = logger.level, logger.propagate

    class Tracing(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            simulation.note(f"{current()}: {record.levelname}: {record.getMessage()}")

    handler = Tracing()
    logger.addHandler(handler)
    logger.propagate = False
    logger.setLevel(logging.INFO if simulation._tracing else logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
        logger.setLevel(level)


def prepared(scene: Scene, kind: type[Simulation] = Simulation) -> Base:
    """The cluster of a scene at rest. It is made once, and many runs begin from it."""
    return _prepared(dataclasses.replace(scene, troubles=(), weather=()), kind)


@functools.cache
def _prepared(scene: Scene, kind: type[Simulation]) -> Base:
    with tempfile.TemporaryDirectory() as folder:
        simulation = kind(scene, 0, None, Path(folder))
        try:
            outcome = simulation.run()
            assert not outcome.faults, str(outcome)
            return simulation.base()
        finally:
            simulation.dispose()


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also tells all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    base = prepared(scene)
    with tempfile.TemporaryDirectory() as folder:
        simulation = Simulation(scene, seed, base, Path(folder), tracing=tracing)
        try:
            return simulation.run()
        finally:
            simulation.dispose()
