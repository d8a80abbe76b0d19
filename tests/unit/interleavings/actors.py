"""The monitors and the operator as processes that can be killed: their real code over the simulated network."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import aiohttp

from tests.unit.interleavings import gates
from tests.unit.interleavings.apiserver import ApiServer
from tests.unit.interleavings.blanks import BlackBox, Keeping, RobotReaders
from tests.unit.interleavings.drivers import Says
from tests.unit.interleavings.gates import NAMESPACE
from tests.unit.interleavings.kept_states import KeptStates
from tests.unit.interleavings.network import Network, SimulatedClient
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scheduling import Killed, Process
from tests.unit.interleavings.senses import HealthObserver, Probes
from tests.unit.interleavings.state_managers import ModelStateManager, Samples
from understudy.api import names
from understudy.controller.plan import Images
from understudy.controller.reconcile.executor import Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import Rollouts
from understudy.controller.runtime import kopf_handlers, watches
from understudy.controller.runtime import process as running
from understudy.controller.runtime.workers import Operator
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity
from understudy.kube import claims
from understudy.kube.client import NODES, PODS, ApiError, Client, Expired, Object, Resource
from understudy.kube.events import Recorder
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord, Proof
from understudy.kube.leader_election import LeadershipLost, Lease, Timing
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import Wakeups
from understudy.monitor.report.status_writer import StatusWriter

RESYNC = 30.0
LEASE = "understudy-operator"
TIMING = Timing(lasts=4.0, renew_within=2.5, every=1.0)
"""Duration of the operators' leader lock: shorter than the real one, because failures are short in the model."""


class Silent(Recorder):
    """Events aren't what is looked at here."""

    def __init__(self) -> None:
        return

    async def normal(self, item: Object, reason: str, message: str) -> None:
        return

    async def warning(self, item: Object, reason: str, message: str) -> None:
        return


class Fuse(CrashPoints):
    """Kills its monitor at the crash point after so many."""

    def __init__(self, process: Process, kill: Callable[[Process], None]) -> None:
        self._process, self._kill = process, kill
        self.left: int | None = None

    def step(self, name: str) -> None:
        if not self._process.alive:
            raise Killed
        if self.left is None:
            return
        self.left -= 1
        if self.left < 0:
            self.burn()

    def burn(self) -> None:
        """Kill the monitor."""
        self._kill(self._process)
        raise Killed


class Monitor:
    """One monitor of one workload, from its start to its end."""

    gate_kind = registry.DEFAULT

    def __init__(
        self,
        process: Process,
        network: Network,
        robots: Robots,
        workload: str,
        journal: Path,
        kill: Callable[[Process], None],
        broken: Callable[[str], None],
        states: KeptStates | None = None,
        *,
        pod: PodIdentity,
    ) -> None:
        """``kill`` kills a process; ``broken`` is called with what doesn't hold. Without ``states``, no state is kept."""
        self._states = states
        self.process, self.workload, self.pod = process, workload, pod
        self._broken, self._gate = broken, cast("Object | None", None)
        self._network, self._robots, self._journal = network, robots, journal
        self.fuse = Fuse(process, kill)
        self.wakeups = Wakeups()
        self.current = CurrentRecovery()
        self._view: ClusterView | None = None
        self.notices: Notices | None = None
        self._observer: HealthObserver | None = None
        self.hindered_at = self.cut_off_at = self.recovered_at = robots.now
        """When (Unix seconds) something last kept it from noticing what its robot hears, and from acting; and its last recovery."""
        self.is_behind, self.informed_at = False, robots.now
        """Whether somebody has switched its gate and it does not know; and when (Unix seconds) it last learned of that late."""

    def note_hindrance(self) -> None:
        """Note whether something keeps it from noticing what its robot hears, or from acting."""
        now, network, process = self._robots.now, self._network, self.process
        paused = "pause" in network.server.items["robotworkloads"][(NAMESPACE, self.workload)]["spec"]
        if process.stalled or self._view is None or self.notices is None or self._view.policy is None:
            self.hindered_at = self.cut_off_at = now
        elif paused or process in network.cut_off or process in network.denied or network.weather.slow:
            self.cut_off_at = now
        if self.current.progress is not None:
            self.recovered_at = now
        self.is_behind = _epoch(gates.find(network.server, self.workload)) > _epoch(self._gate)

    @property
    def is_hindered(self) -> bool:
        """Whether something keeps it from acting, or it pauses between two recoveries because no strategy was verified."""
        waits = self.notices is not None and self.notices.status.reason("Recovering") == "NothingVerified"
        return self.cut_off_at == self._robots.now or waits

    def says(self) -> Says | None:
        """What it says of its robot; None while it has just begun."""
        if self.notices is None:
            return None
        status = self.notices.status
        sole = next((c["status"] for c in status.to_wire()["conditions"] if c["type"] == "SoleDriver"), "Unknown")
        return Says(
            str(self.process),
            status.health,
            sole,
            self.recovered_at,
            max(self.hindered_at, self.informed_at),
            self.cut_off_at,
            self.knows,
            self._view is not None and self._view.gate_record is not None,
        )

    @property
    def knows(self) -> frozenset[str]:
        """The UIDs of the instances that it knows."""
        return frozenset(one.uid for one in self._observer.known_senders()) if self._observer else frozenset()

    def knew(self, at: float) -> frozenset[str]:
        """The UIDs of the instances that it knew at a time (Unix seconds)."""
        known = self._observer.known_since if self._observer else {}
        return frozenset(uid for uid, since in known.items() if since <= at)

    def _make_agents(self, client: Client, view: ClusterView, roles: InstanceRoles, probes: Proof) -> AgentConnections:
        return AgentConnections(client, view, self.workload, self.fuse, roles, self.wakeups, probes)

    def _make_state_manager(self, agents: AgentConnections, notices: Notices) -> StateManager:
        if self._states is None:
            return cast(StateManager, Keeping())
        samples = Samples(self.process, self._robots, self.workload)
        return ModelStateManager(samples, self._states, self.workload, self._journal.with_suffix(""), agents, notices)

    def _make_observer(self) -> HealthObserver:
        return HealthObserver(self.process, self._robots, self.workload, self._look_at_gate)

    def _make_probes(self) -> Proof:
        return Probes(self.process, self._robots, self.workload)

    def _beside(self, loop: MonitorLoop, parts: Parts, group: asyncio.TaskGroup) -> None:
        """Have run beside the supervisor what else there is."""
        return

    async def run(self) -> None:
        """As ``understudy.monitor.process`` puts it together."""
        client = self._network.client(self.process)
        async with asyncio.TaskGroup() as group:
            view = self._view = ClusterView(client, NAMESPACE, self.workload, self.wakeups, self.gate_kind, self.pod)
            await view.run(group)
            notices = self.notices = Notices(PublishedStatus.adopt(view.object))
            fleet = PodControl(client, view, self.fuse, notices)
            probes = self._make_probes()
            gate = GateControl(client, view, fleet, probes, self.fuse, notices)
            roles = InstanceRoles(view, gate, self.current)
            agents = self._make_agents(client, view, roles, probes)
            self._observer = self._make_observer()
            observer = cast(Any, self._observer)
            parts = Parts(
                cluster=Cluster(view, fleet, gate),
                senses=Senses(observer, agents, probes, cast(Any, RobotReaders()), roles, self.wakeups),
                state_manager=self._make_state_manager(agents, notices),
                journal=RecoveryJournal(Journal(self._journal), self.fuse),
                black_box=cast(Any, BlackBox()),
                notices=notices,
            )
            monitor_loop = MonitorLoop(parts)
            self._beside(monitor_loop, parts, group)
            group.create_task(StatusWriter(client, view, Silent(), notices).run())
            await monitor_loop.run()

    def _look_at_gate(self) -> None:
        if self._view is not None:
            self._look(self._view.gates.items.get(names.gate(self.workload)))

    def _look(self, gate: Object | None) -> None:
        """What it knows of its gate never goes back, unless somebody has deleted the gate."""
        before, self._gate = self._gate, gate
        if self.is_behind and _epoch(gate) > _epoch(before):
            self.is_behind, self.informed_at = False, self._robots.now
        if before is None or gate is None or before["metadata"]["uid"] != gate["metadata"]["uid"]:
            return
        old, new = (int(found["metadata"]["resourceVersion"]) for found in (before, gate))
        if new < old:
            epochs = [GateRecord.of(found).epoch for found in (before, gate)]
            self._broken(f"{self.process} knew epoch {epochs[0]} of its gate, and then {epochs[1]}")

    def mistaken(self, server: ApiServer) -> Iterator[str]:
        """What it takes to be so of its pods and its gate, and isn't; and what it says, and nobody reads."""
        view = self._view
        if view is None:
            return
        if self.notices is not None:
            status = server.items["robotworkloads"][(NAMESPACE, self.workload)].get("status") or {}
            reported = self.notices.status.to_wire()
            for key in [key for key in reported if key != "conditions" and reported[key] != status.get(key)]:
                yield f"{self.process} says another {key} than the status"
            for condition in reported["conditions"]:
                if condition not in (status.get("conditions") or []):
                    yield f"{self.process} says another condition {condition['type']} than the status"
        pods = server.items["pods"].values()
        labels = {pod["metadata"]["name"]: pod["metadata"].get("labels") or {} for pod in pods}
        found = {
            p["metadata"]["name"]: p for p in pods if claims.workload_of(labels[p["metadata"]["name"]]) == self.workload
        }
        yield from _differences(str(self.process), {p["metadata"]["name"]: p for p in view.all_pods()}, found)
        gate = gates.find(server, self.workload)
        found = {names.gate(self.workload): gate} if gate is not None else {}
        yield from _differences(str(self.process), view.gates.items, found)

    def wake(self) -> None:
        """Have it look at once."""
        self.wakeups.evaluation.set()


def _epoch(gate: Object | None) -> int:
    """The epoch of a gate; 0 if there is none."""
    return GateRecord.of(gate).epoch if gate is not None else 0


def _differences(who: str, known: Mapping[str, Object], found: Mapping[str, Object]) -> Iterator[str]:
    for name in sorted(known.keys() | found.keys()):
        mine, real = (side[name]["metadata"]["resourceVersion"] if name in side else "none" for side in (known, found))
        if mine != real:
            yield f"{who} knows version {mine} of {name}, and there is {real}"


class OperatorProcess:
    """One replica of the operator, from its start to its end: what it expects is lost with it."""

    def __init__(
        self,
        process: Process,
        network: Network,
        replica: str,
        choices: random.Random,
        kill: Callable[[Process], None],
    ) -> None:
        """``replica`` is the same after a restart; ``kill`` is called when it ends by itself."""
        self.process, self.replica, self._kill = process, replica, kill
        self._network, self._choices = network, choices
        client = network.client(process, timeout=20)
        self._client: SimulatedClient = client
        clock = network.loop.time
        self._store, expectations = Store(clock=clock), Expectations(clock=clock)
        self._lease = Lease(client, NAMESPACE, LEASE, replica, timing=TIMING, clock=clock)
        reconciler = Reconciler(
            client,
            self._store,
            Observer(client, self._store, expectations),
            Executor(client, self._store, expectations, may_write=lambda: self._lease.held),
            Silent(),
            Images("registry/understudy:1"),
            Rollouts(self._store, clock=clock),
        )
        self._operator = Operator(client, self._store, reconciler, namespaces=[NAMESPACE], resync_every=RESYNC)
        self.silent: set[str] = set()
        """Resources whose watch says nothing any more, without an error."""
        self._told_to_end = network.loop.create_future()

    def mistaken(self, server: ApiServer) -> Iterator[str]:
        """What it takes to be so of pods and gates, and isn't."""
        found = {name: item for (_, name), item in server.items[PODS.plural].items()}
        yield from _differences(str(self.process), self._store.in_namespace(PODS, NAMESPACE), found)
        for plural, kind in gates.KINDS.items():
            found = {name: item for (_, name), item in server.items[plural].items() if name != LEASE}
            known = self._store.in_namespace(kind.resource, NAMESPACE)
            mine = {name: item for name, item in known.items() if name != LEASE}
            yield from _differences(str(self.process), mine, found)

    async def run(self) -> None:
        """As ``understudy.controller.runtime.process`` puts it together."""
        watched = [*kopf_handlers.WATCHED, *(resource for resource, labels in watches.WATCHED if labels is None)]
        work = [*map(self._watch, watched), self._operator.keep_listing()]
        tasks = [
            asyncio.create_task(one)
            for one in (*work, running.lead(self._lease, self._operator), self._until_notified())
        ]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        ended = [task.exception() for task in tasks if task.done()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._lease.release()
        for error in ended:
            if error is not None and not (isinstance(error, BaseExceptionGroup) and error.subgroup(LeadershipLost)):
                raise error
        self._kill(self.process)

    async def _until_notified(self) -> None:
        await self._told_to_end

    def end(self) -> None:
        """As SIGTERM does."""
        if not self._told_to_end.done():
            self._told_to_end.set_result(None)

    async def _watch(self, resource: Resource) -> None:
        """What kopf and ``following`` do for it."""
        namespace = NAMESPACE if resource != NODES else None
        while True:
            try:
                answer = await self._client.list(resource, namespace)
                for item in answer["items"]:
                    self._operator.see(resource, item, False)
                version = answer["metadata"]["resourceVersion"]
                while True:
                    async for kind, item in self._client.watch(resource, namespace, version=version):
                        version = item["metadata"]["resourceVersion"]
                        if resource.plural not in self.silent:
                            self._operator.see(resource, item, kind == "DELETED")
            except (ApiError, aiohttp.ClientError, TimeoutError, OSError, Expired):
                await asyncio.sleep(self._choices.random() * 2)
