"""The processes of a run: an API server, a network, robots, monitors and operators in one virtual time."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.unit.interleavings.actors import LEASE, NAMESPACE, Monitor, OperatorProcess
from tests.unit.interleavings.apiserver import EPOCH, ApiServer, stamp
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.network import Network
from tests.unit.interleavings.pauses import Pauses
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scenes import Outcome, Scene
from tests.unit.interleavings.scheduling import Killed, Process, VirtualLoop
from understudy import clock
from understudy.failover.progress import PodIdentity
from understudy.kube.client import Object


@dataclass
class Base:
    """A cluster at rest, from which runs begin."""

    server: ApiServer
    running: dict[str, Running]
    let_through: dict[str, tuple[str, ...]]
    time: float


class SimulatedCluster:
    """What runs, starts again and is judged, without anything that goes wrong."""

    def __init__(self, scene: Scene, seed: int, base: Base | None, folder: Path, *, tracing: bool = False) -> None:
        self.scene, self.choices = scene, random.Random(f"{scene.name}/{seed}")
        self.outcome = Outcome(seed, scene.name)
        self._folder, self.tracing = folder, tracing
        self.loop = VirtualLoop(self.choices, now=base.time if base else 0.0)
        self.loop.surprised = self._surprised
        self.world = self.loop.process("world")
        clock: Callable[[], float] = lambda: EPOCH + self.loop.time()  # noqa: E731
        self.server = base.server.restored(clock) if base else ApiServer(clock)
        self.network = Network(self.loop, self.server, self.choices, self.world)
        self.robots = self._make_robots()
        if base is not None:
            self.robots.adopt(base.running, base.let_through)
        self.robots.changed = self._output_received
        self.robots.started = lambda workload, found: self.invariants.started(workload, found.uid, found.place)
        self.invariants = self._make_invariants()
        self.pauses = Pauses(self.server, self.loop.time, self.note, self.invariants.fenced)
        self.robots.restored = self.invariants.kept_states.given
        self.robots.commanded = self.invariants.commands.carried_out
        self.robots.commanded_safely = self.invariants.drivers.commanded_safely
        self.invariants.drivers.knew = self._known_to
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

    def _make_monitor(self, process: Process, workload: str, journal: Path, pod: PodIdentity) -> Monitor:
        return Monitor(
            process,
            self.network,
            self.robots,
            workload,
            journal,
            self.kill,
            self._broken,
            self.invariants.kept_states if self.scene.keeps else None,
            pod=pod,
        )

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        """What else has to be so for the time of the run: targets, attributes and their values."""
        yield clock, "_BOOT", Path("/nonexistent")  # this machine's clock is not the run's

    @property
    def workloads(self) -> list[str]:
        return self.scene.workload_names

    def next_name(self, prefix: str) -> str:
        """The name of the next pod."""
        return f"{prefix}-{next(self._names):04}"

    def note(self, text: str) -> None:
        """A line of the trace."""
        if self.tracing:
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
        if self.tracing and plural == "pods" and (item := new or old) is not None:
            phase = (item.get("status") or {}).get("phase", "Pending")
            text = "gone" if new is None else "leaving" if "deletionTimestamp" in item["metadata"] else phase
            self.note(f"  pod {item['metadata']['name']} {text}, by {by}")

    def _known_to(self, monitor: str, at: float) -> frozenset[str]:
        return frozenset[str]().union(*(one.knew(at) for one in self.monitors if str(one.process) == monitor))

    def _output_received(self, robot: str) -> None:
        self.invariants.routed(robot)
        for monitor in self.monitors:
            if monitor.workload == robot and monitor.process.alive:
                self.loop.call_soon(monitor.wake, context=monitor.process.context)

    # -- processes --------------------------------------------------------------------------------------------------

    def start_operator(self, replica: str) -> None:
        """A replica of the operator, which expects nothing."""
        process = self.loop.process(f"operator-{next(self._incarnations)} ({replica})")
        operator = OperatorProcess(process, self.network, replica, self.choices, self.kill)
        self.operators.append(operator)
        self.note(f"{process} starts")
        self._follow(process, operator.run())

    def start_monitor(self, workload: str, journal: str) -> None:
        """A new monitor; the journal is of the pod in which it runs. The pod that it replaces is being deleted."""
        for other in self.monitors:
            if (
                other.workload == workload
                and (old := self.server.unlisted.get((NAMESPACE, other.pod.name))) is not None
            ):
                old["metadata"]["deletionTimestamp"] = stamp(self.robots.now)
        process = self.loop.process(f"monitor-{next(self._incarnations)} of {workload}")
        file = self._folder / f"{self.outcome.seed}-{workload}-{journal}.json"
        monitor = self._make_monitor(process, workload, file, self._create_monitor(workload, journal))
        self.monitors.append(monitor)
        self._journals[process.name] = journal
        self.note(f"{process} starts")
        self._follow(process, monitor.run())

    def _create_monitor(self, workload: str, journal: str) -> PodIdentity:
        """The pod of a monitor, which is a new one if there is none with this journal."""
        name = _pod_of_monitor(workload, journal)
        pod = {"metadata": {"name": name, "uid": f"{name}-uid", "resourceVersion": "1"}}
        uid = self.server.unlisted.setdefault((NAMESPACE, name), pod)["metadata"]["uid"]
        return PodIdentity(name=name, uid=uid)

    def delete_monitor(self, pod: str) -> None:
        """The pod of a monitor is gone, and its process may live on."""
        if self.server.unlisted.pop((NAMESPACE, pod), None) is not None:
            self.note(f"  pod {pod} gone")

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
        self.network.tcp.ended(process)
        for operator in [o for o in self.operators if o.process is process]:
            self.operators.remove(operator)
            self.later(self.choices.random() * 2, self.start_operator, operator.replica)
            return
        monitor = next(m for m in self.monitors if m.process is process)
        self.monitors.remove(monitor)
        if any(m.workload == monitor.workload for m in self.monitors):
            self.delete_monitor(monitor.pod.name)
            self._monitor_pod_ended(monitor.pod.name)
        else:
            pod = self.server.unlisted.get((NAMESPACE, monitor.pod.name))
            exists = pod is not None and "deletionTimestamp" not in pod["metadata"]
            moved = self.choices.random() < 0.25 or not exists
            journal = f"other-{next(self._ids)}" if moved else self._journals[process.name]
            if moved:
                self.delete_monitor(monitor.pod.name)
                self._monitor_pod_ended(monitor.pod.name)
                self.note(f"the next monitor of {monitor.workload} starts elsewhere, its journal is lost")
            self.later(0.1 + self.choices.random() * 2, self._start_again, monitor.workload, journal)

    def _start_again(self, workload: str, journal: str) -> None:
        # Meanwhile its Deployment may have made another one.
        if not self._calm or not any(monitor.workload == workload for monitor in self.monitors):
            self.start_monitor(workload, journal)
        else:
            self.delete_monitor(_pod_of_monitor(workload, journal))
            self._monitor_pod_ended(_pod_of_monitor(workload, journal))

    def _monitor_pod_ended(self, pod: str) -> None:
        """The processes of a monitor's pod have ended for good."""

    def later(self, seconds: float, work: Callable[..., object], *args: object) -> None:
        """Do something in the world after so many seconds."""
        self.loop.call_later(seconds, work, *args, context=self.world.context)


def _pod_of_monitor(workload: str, journal: str) -> str:
    """The name of the pod of a monitor; its journal is in a volume of the pod."""
    return f"{workload}-monitor-{journal}"
