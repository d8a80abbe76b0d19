"""Runs with tasks: clients send goals to action proxies, and instances that fail work on them.

The real code of the proxy, of its connection to the monitor, of its succession and of the agents' goals runs over a model of clients and
of action servers. What must hold is said in task_clients.py.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tests.unit.interleavings import simulation, task_proxies
from tests.unit.interleavings.actors import NAMESPACE, Monitor
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.scheduling import Killed, Process
from tests.unit.interleavings.simulation import Simulation
from tests.unit.interleavings.task_applications import Application, PodGoals
from tests.unit.interleavings.task_clients import Clients
from tests.unit.interleavings.task_proxies import Answer, Endpoints, Pod
from tests.unit.interleavings.troubles import TROUBLES
from understudy.agent.restoration.task_goals import TaskGoals
from understudy.api.protocol.agent_messages import GateEpoch
from understudy.failover.progress import PodIdentity
from understudy.kube.client import Object
from understudy.monitor.act.action_proxy_link import ActionProxyLink
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.own_pod import PodDeleted, end_if_deleted

FIRST = 2_000_000
"""From this seed on runs are of tasks."""

SCENES = (
    Scene("tasks", workloads=2, strategies=("hot", "Restart"), standbys=1, tasks="Resend"),
    Scene("tasks and claims", workloads=2, strategies=("spare", "Restart"), spares=2, tasks="Resend"),
    Scene("tasks that are aborted", workloads=1, strategies=("hot", "Restart"), standbys=1, tasks="Abort"),
)

PAUSES = (0.5, 4.0)
"""Least and most seconds between two goals of a client."""

ABORTS = 0.5
"""How often an application aborts its goals at the signal to end."""


class TaskMonitor(Monitor):
    """A monitor with a proxy in its pod."""

    socket = Path()

    def _beside(self, loop: MonitorLoop, parts: Parts, group: asyncio.TaskGroup) -> None:
        cluster, senses = parts.cluster, parts.senses
        link = ActionProxyLink(
            self.socket, cluster.view, cluster.pods, cluster.gate, senses.agents, parts.notices, senses.observer
        )
        group.create_task(link.run())
        group.create_task(self._end_if_deleted(cluster.view))

    async def _end_if_deleted(self, view: ClusterView) -> None:
        try:
            await end_if_deleted(view)
        except PodDeleted:
            self.fuse.burn()


class Tasked(Simulation):
    """A run with tasks."""

    causes: Mapping[str, int] = TROUBLES | {"action_proxy_dies": 6}

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self._agents_goals: dict[str, Application] = {}
        super().__init__(*arguments, **more)
        network, self.robots.commanded = self.network, self._commanded
        self.endpoints = Endpoints(network.tcp, self._is_reached, lambda answer: self._received(answer))
        self.clients = Clients(
            self.robots,
            self.endpoints,
            aborts=self.scene.tasks == "Abort",
            broken=self._broken,
            note=self.note,
            behind=lambda workload: any(m.is_behind for m in self.monitors if m.workload == workload),
            commands=self.invariants.commands,
        )
        passes = network.tcp.open
        network.tcp.open = lambda process, host: (
            host.startswith("/") or (self._is_reached(process) and passes(process, host))
        )

    def _make_robots(self) -> Robots:
        made = super()._make_robots()
        made.goals = self._goals
        return made

    def _goals(self, found: Running, publish: Any) -> TaskGoals:
        if (application := self._agents_goals.get(found.uid)) is None:
            application = self._agents_goals[found.uid] = Application(self.robots, found, self)
        return PodGoals(application, publish)

    def _something_is_deleted(self) -> None:
        before = set(self.server.items[self.gate_plural])
        super()._something_is_deleted()
        for _, gate in before - set(self.server.items[self.gate_plural]):
            self.clients.gate_deleted(gate.removesuffix("-gate"))

    def _commanded(self, found: Running, op: str, epoch: GateEpoch, by: str) -> None:
        """An agent carries out a command. While no monitor knows of the last switch, neither do the proxy and the agent: what a client
        still reaches the instance that drives."""
        unknown = all(m.is_behind for m in self.monitors if m.workload == found.robot)
        if not (op in ("goal", "cancel") and by.startswith("action-proxy") and unknown):
            self.invariants.commands.carried_out(found, op, epoch, by)

    def begun(self, found: Running, goal: str) -> None:
        """An instance begins to work on a goal."""
        self.clients.begun(found, goal)

    def completed(self, found: Running, goal: str) -> None:
        """An instance has reached a goal."""
        self.clients.completed(found, goal)

    def replaced(self, found: Running, goal: str) -> None:
        """An instance has ended a goal for a newer one."""
        self.clients.replaced(found, goal)

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        yield from super().patches()
        yield from self.endpoints.patches()

    # -- proxies ----------------------------------------------------------------------------------------------------

    def _make_monitor(self, process: Process, workload: str, journal: Path, pod: PodIdentity) -> Monitor:
        made = TaskMonitor(process, self.network, self.robots, workload, journal, self.kill, self._broken, pod=pod)
        made.socket = journal.with_suffix(".sock")
        if pod.name not in self.endpoints.pods:
            self.clients.moves(workload)  # an earlier pod may live on, and reach nobody
            folder = journal.with_suffix(".tasks")
            self.endpoints.pods[pod.name] = Pod(workload, pod.name, folder, made.socket)
            self._start_proxy(pod.name)
        return made

    def _is_reached(self, process: Process) -> bool:
        """Whether a process is no proxy, or one whose pod reaches others."""
        pod = next((one for one in self.endpoints.pods.values() if one.process is process), None)
        apart = {m.pod.name for m in self.monitors if m.process in self.network.apart}
        return pod is None or pod.name not in apart

    def _start_proxy(self, name: str) -> None:
        pod = self.endpoints.pods.get(name)
        if pod is None or pod.process is not None:
            return
        process = pod.process = self.loop.process(f"action-proxy-{next(self._incarnations)} of {pod.workload}")
        self.note(f"{process} starts")
        task = self.loop.start(process, task_proxies.run(pod, NAMESPACE))

        def ended(_: object) -> None:
            error = task.exception() if not task.cancelled() else None
            if self._disposed or not process.alive:
                return
            if error is not None and not isinstance(error, Killed):
                self._broken(f"{process} ended by itself: {error!r}")
            else:
                self._end_proxy(pod)

        task.add_done_callback(ended, context=self.world.context)

    def _end_proxy(self, pod: Pod, *, for_good: bool = False) -> None:
        """A proxy's process ends, and its kubelet starts it again if its pod is still there."""
        if (process := pod.process) is not None:
            self.note(f"{process} ends")
            process.kill()
            self.network.tcp.ended(process)
            self.endpoints.ended(process)
            pod.process = None
        if for_good:
            self.endpoints.pods.pop(pod.name, None)
        else:
            self.later(0.1 + self.choices.random() * 2, self._start_proxy, pod.name)

    def _monitor_pod_ended(self, name: str) -> None:
        if (pod := self.endpoints.pods.get(name)) is not None:
            self.clients.moves(pod.workload)
            self._end_proxy(pod, for_good=True)

    def _action_proxy_dies(self) -> None:
        found = sorted(self.endpoints.pods)
        if found:
            self._end_proxy(self.endpoints.pods[self.choices.choice(found)])

    # -- clients and applications -----------------------------------------------------------------------------------

    def _received(self, answer: Answer) -> None:
        self.clients.received(answer)

    def _take_up(self) -> None:
        super()._take_up()
        for workload in self.workloads:
            self._ask(workload)

    def _ask(self, workload: str) -> None:
        """Have the client of a workload send goals until nothing goes wrong any more."""
        if self._calm:
            return
        self.clients.send(workload)
        least, most = PAUSES
        self.later(least + (most - least) * self.choices.random(), self._ask, workload)

    def _written(self, plural: str, old: Object | None, new: Object | None, by: str) -> None:
        super()._written(plural, old, new, by)
        if plural == "pods" and old is not None and new is not None:
            is_told = "deletionTimestamp" in new["metadata"] and "deletionTimestamp" not in old["metadata"]
            application, found = (of.get(new["metadata"]["uid"]) for of in (self._agents_goals, self.robots.running))
            if not is_told or application is None or found is None or self.robots.nodes.is_forgotten(found.node):
                return
            if self.choices.random() < ABORTS:
                application.abort()

    def _look_at_drivers(self) -> None:
        super()._look_at_drivers()
        self.clients.look(self.workloads)

    def _mistaken(self) -> Iterator[str]:
        yield from super()._mistaken()
        yield from self.clients.unrest()

    def run(self) -> Outcome:
        outcome = super().run()
        outcome.tasks = dict(self.clients.counts)
        return outcome


def run(seed: int, *, tracing: bool = False, scene: Scene | None = None) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also tells all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    return simulation.made(Tasked, scene, seed, simulation.prepared(scene, Tasked), tracing=tracing)
