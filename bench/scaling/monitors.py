"""Many monitors in one process, real except for their senses (bench/scaling/senses.py), each with its own account,
connections and watches. Run as a role of the bench (bench/roles.py).
"""

from __future__ import annotations

import asyncio
import gc
import logging
import resource
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import aiohttp

from bench.roles import answer, end_with_parent, tell
from bench.scaling.fleets import POOL, Robot
from bench.scaling.senses import AgentConnections, Application, HealthObserver, Probes
from bench.scaling.watches import Borrowed, Drain
from tests.unit.interleavings.blanks import BlackBox, Keeping, RobotReaders
from understudy.api import names
from understudy.failover.interfaces import Instance
from understudy.failover.journal import Journal
from understudy.failover.pool_queue import CHECK_PERIOD
from understudy.failover.progress import Progress
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.kube.client import NETWORK_POLICIES, Access, ApiError
from understudy.kube.events import Recorder
from understudy.kube.kubeconfig import load_access
from understudy.kube.warm_connections import keep_warm
from understudy.kube.watched_collection import Reflector
from understudy.monitor import loop
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import Wakeups
from understudy.monitor.report.status_writer import StatusWriter

TICK = 10.0
"""Maximum seconds between two rounds of a monitor. Its senses are simulated here and wake it."""

AT_ONCE = 16
"""Monitors that start at the same time."""

CLAIM_WITHIN = 20.0
"""Seconds after which a claim that found no pod counts as lost."""

_UNREACHABLE = (ApiError, aiohttp.ClientError, TimeoutError, OSError)


class Recording(Notices):
    """Reports each recovery as it is recorded."""

    robot = ""
    intended = 0.0
    """The planned time of the failure, in unix seconds."""

    def record(self, progress: Progress) -> Any:
        """Add a finished recovery."""
        moments = progress.moments
        tell(
            "recovered",
            robot=self.robot,
            result=progress.result,
            strategy=progress.strategy,
            intended=self.intended,
            attempts=[f"{a.strategy}: {a.result} {a.message}" for a in progress.attempts],
            moments={name: moments[name] for name in sorted(moments)},
        )
        return super().record(progress)


class PodWakeups(Wakeups):
    """Wakes a monitor, but not for a pod that the monitor claims itself."""

    claiming = False

    def pod_changed(self) -> None:
        if not self.claiming:
            super().pod_changed()


class Monitor:
    """One robot's monitor."""

    def __init__(self, robot: Robot, client: Drain, waiting: Reflector, state: Path) -> None:
        """``waiting`` is a copy of the gates of the robot's namespace that wait for pods. All monitors of the namespace
        share it."""
        self.robot, self._client, self._waiting, self._state = robot, client, waiting, state
        self.application = Application()
        self.wakeups, self.current = PodWakeups(), CurrentRecovery()
        self.monitor_loop: MonitorLoop | None = None
        self.fleet: PodControl | None = None
        self.gate: GateControl | None = None
        self.notices: Recording | None = None

    async def run(self, watching: asyncio.Event) -> None:
        """Run the parts as ``understudy.monitor.process`` composes them; ``watching`` is set once their copies are
        complete."""
        client, namespace = self._client, self.robot.namespace
        async with asyncio.TaskGroup() as group:
            view = ClusterView(client, namespace, self.robot.name, self.wakeups)
            view.waiting_gates = [Borrowed(self._waiting, client, NETWORK_POLICIES, namespace, labels=names.WAITS_FOR)]
            await view.run(group)
            crash_points = CrashPoints(self._state)
            self.notices = Recording(PublishedStatus.adopt(view.object))
            self.notices.robot = self.robot.key
            self.fleet = PodControl(client, view, crash_points, self.notices)
            probes = Probes(self.application)
            self.gate = probes.gate = GateControl(client, view, self.fleet, probes, crash_points, self.notices)
            recorder = Recorder(client, "understudy-monitor", "bench")
            roles = InstanceRoles(view, self.gate, self.current)
            agents, observer = (
                cast(Any, AgentConnections(self.application)),
                cast(Any, HealthObserver(self.application)),
            )
            readers = cast(Any, RobotReaders())
            parts = Parts(
                cluster=Cluster(view, self.fleet, self.gate),
                senses=Senses(observer, agents, cast(Any, probes), readers, roles, self.wakeups),
                state_manager=cast(Any, Keeping()),
                journal=RecoveryJournal(Journal(self._state / "recovery.json"), crash_points),
                black_box=cast(Any, BlackBox()),
                notices=self.notices,
            )
            self.monitor_loop = MonitorLoop(parts)
            group.create_task(keep_warm(client))
            group.create_task(StatusWriter(client, view, recorder, self.notices).run())
            watching.set()
            await self.monitor_loop.run()

    def wake(self) -> None:
        """Wake the monitor at once."""
        self.wakeups.pod_changed()

    @property
    def drives(self) -> str:
        """UID of the active instance if its outputs flow and there is no recovery, else empty."""
        if self.gate is None or self.monitor_loop is None or self.current.progress is not None:
            return ""
        uid = self.gate.state.active_uid
        return uid if self.application.well(uid) else ""

    def fail(self, intended: float) -> bool:
        """Let the active instance fail now, and return whether there was one."""
        uid = self.drives
        if not uid or self.notices is None:
            return False
        self.notices.intended = intended
        self.application.failed[uid] = time.time()
        self.wake()
        return True

    async def claim(self, intended: float) -> None:
        """Claim a pod of the pool as a recovery does, without the rest of a recovery."""
        assert self.monitor_loop is not None
        self.wakeups.claiming = True
        begun = time.time()
        strategy = UninitializedFallback(POOL)
        progress = Progress.begin("claim", last_healthy=begun, detected=begun)
        context = self.monitor_loop.decide.options.context()
        found: Instance | None = None
        error = "no pod was free"
        while found is None and time.time() < begun + CLAIM_WITHIN:
            try:
                await strategy.refresh(context, progress)
                found = await strategy._claim(progress, context)
            except _UNREACHABLE as reason:
                error = repr(reason)
                break
            if found is None:
                await asyncio.sleep(CHECK_PERIOD)
        self.wakeups.claiming = False
        tell(
            "claimed",
            robot=self.robot.key,
            intended=intended,
            begun=begun,
            done=time.time(),
            uid=found.uid if found is not None else "",
            claim=found.claim if found is not None else "",
            lost=len(strategy._lost),
            error="" if found is not None else error,
        )


class Process:
    """All monitors of this process."""

    def __init__(self, kubeconfig: str, folder: Path) -> None:
        self._access = load_access(kubeconfig)
        self._folder = folder
        self._monitors: dict[str, Monitor] = {}
        self._waiting: dict[str, Reflector] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._at_once = asyncio.Semaphore(AT_ONCE)

    # -- what it is asked -------------------------------------------------------------------------------------------

    def begin(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Start monitors: ``robots`` has namespace, name and token of each."""
        for namespace, name, token in asked["robots"]:
            self._do(self._protect(Robot(namespace, name), token))
        return {}

    def state(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return how many monitors there are, and how many of their robots are driven."""
        return {"monitors": len(self._monitors), "driven": sum(bool(m.drives) for m in self._monitors.values())}

    def settle(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Exclude all present objects from garbage collection, which would stop every monitor of this process at once."""
        gc.collect()
        gc.freeze()
        return {}

    def fail(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Let robots fail: ``failures`` has unix time and robot of each."""
        for at, robot in asked["failures"]:
            self._do(self._fail(at, self._monitors[robot]))
        return {}

    def claim(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Let robots claim pods: ``claims`` has unix time and robot of each."""
        for at, robot in asked["claims"]:
            self._do(self._claim(at, self._monitors[robot]))
        return {}

    # -- what it does -----------------------------------------------------------------------------------------------

    def _do(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            tell("broken", error=repr(error.exceptions if isinstance(error, BaseExceptionGroup) else error))

    async def _protect(self, robot: Robot, token: str) -> None:
        state = self._folder / robot.namespace / robot.name
        state.mkdir(parents=True)
        access = replace(self._access, token=token, context=_shared(self._access))
        watching = asyncio.Event()
        async with Drain(access, timeout=60) as client:
            await self._at_once.acquire()
            if robot.namespace not in self._waiting:
                copy = Reflector(client, NETWORK_POLICIES, robot.namespace, labels=names.WAITS_FOR)
                self._waiting[robot.namespace] = copy
                self._do(copy.run())
            monitor = self._monitors[robot.key] = Monitor(robot, client, self._waiting[robot.namespace], state)
            running = asyncio.create_task(monitor.run(watching))
            waiting = asyncio.create_task(watching.wait())
            await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
            self._at_once.release()
            await running

    async def _fail(self, at: float, monitor: Monitor) -> None:
        await asyncio.sleep(at - time.time())
        # The robot may be recovering from another failure, and nothing reports the end of that.
        while not monitor.fail(at):  # noqa: ASYNC110
            await asyncio.sleep(0.05)

    async def _claim(self, at: float, monitor: Monitor) -> None:
        await asyncio.sleep(at - time.time())
        await monitor.claim(at)


def _shared(access: Access) -> Any:
    """Return the context of TLS connections without the administrator's certificate, because monitors authenticate by
    tokens."""
    global _context
    if _context is None:
        import ssl

        authorities = access.context.get_ca_certs(binary_form=True)
        _context = ssl.create_default_context(cadata="".join(ssl.DER_cert_to_PEM_cert(ca) for ca in authorities))
    return _context


_context: Any = None


async def _run(kubeconfig: str, folder: Path) -> None:
    process = Process(kubeconfig, folder)
    answers = {
        "begin": process.begin,
        "state": process.state,
        "settle": process.settle,
        "fail": process.fail,
        "claim": process.claim,
    }
    asyncio.get_running_loop().add_reader(sys.stdin, lambda: answer(sys.stdin.readline(), answers))
    tell("ready")
    await asyncio.Event().wait()


def main(kubeconfig: str) -> None:
    """Run until killed."""
    end_with_parent()
    logging.basicConfig(level=logging.ERROR, stream=sys.stderr, format="monitors: %(name)s %(message)s")
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    loop.TICK = loop.SLOW = TICK  # type: ignore[misc]
    gc.set_threshold(50_000, 20, 100)
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(_run(kubeconfig, Path(folder)))
