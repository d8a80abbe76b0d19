"""The monitor's process: assembles its parts, runs them, and ends on SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from prometheus_client import REGISTRY, generate_latest

from understudy import __version__
from understudy.api import names
from understudy.api.kinds.robot_workload import MonitorStatus
from understudy.api.protocol import mux_messages
from understudy.api.protocol.agent_messages import KEYED_PROTOCOL
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity
from understudy.kube.client import Client
from understudy.kube.events import Recorder
from understudy.kube.gates import registry
from understudy.kube.gates.mux_reports import MuxReports
from understudy.kube.kubeconfig import default_access
from understudy.kube.warm_connections import keep_warm
from understudy.monitor.act.action_proxy_link import ActionProxyLink
from understudy.monitor.act.gate.mux_orders import MuxOrders, ready_names
from understudy.monitor.act.gate.permits import Permits
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.judge.deafness import Deaf, DeafnessWatch, EndedFor
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.own_pod import PodDeleted, end_at_start_if_deleted, end_if_deleted
from understudy.monitor.observe.objects.resource_meter import ResourceMeter
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.robot_readers import RobotReaders
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.wakeups import Wakeups
from understudy.monitor.report import monitor_metrics
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.diagnostics_publisher import DiagnosticsPublisher
from understudy.monitor.report.live_tree_pages import LiveTreePages
from understudy.monitor.report.recording_archive import RecordingArchive
from understudy.monitor.report.status_writer import StatusWriter
from understudy.process import cpu_scheduling, json_logs, loop_turns
from understudy.process.http_pages import Page, serve
from understudy.ros.actions.text_exchange import TextExchange
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.state.state_store import StateStore

_logger = logging.getLogger(__name__)

STATE = Path("/var/lib/understudy")


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT. UNDERSTUDY_WORKLOAD and UNDERSTUDY_NAMESPACE name the workload.

    Returns 75 (EX_TEMPFAIL) if this process is deaf for the active instance and must start again, or if its pod was deleted.
    """
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    workload, namespace = os.environ.get("UNDERSTUDY_WORKLOAD"), os.environ.get("UNDERSTUDY_NAMESPACE")
    if not workload or not namespace:
        print("understudy monitor: set UNDERSTUDY_WORKLOAD and UNDERSTUDY_NAMESPACE", file=sys.stderr)
        return 2
    state = Path(os.environ.get("UNDERSTUDY_STATE", STATE))
    state.mkdir(parents=True, exist_ok=True)
    cpu_scheduling.ask_for_short_slices()
    try:
        loop_turns.run(_run(workload, namespace, state), monitor_metrics.LONG_TURNS)
    except* (Deaf, PodDeleted) as group:
        _logger.error("%s", group.exceptions[0])
        code = os.EX_TEMPFAIL
    else:
        code = 0
    return code


async def _run(workload: str, namespace: str, state: Path) -> None:
    loop = asyncio.get_running_loop()
    running = asyncio.ensure_future(_protect(workload, namespace, state))
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, running.cancel)
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await running
        _logger.info("ended")
    finally:
        # The runner waits for the threads of the default executor. One that writes to a volume that hangs does not end.
        loop.set_default_executor(ThreadPoolExecutor())


def _pod() -> PodIdentity | None:
    """Return the pod of this process; None if its Deployment does not say."""
    name = os.environ.get(names.POD_VARIABLE)
    return PodIdentity(name=name, uid=os.environ.get(names.POD_UID_VARIABLE, "")) if name else None


async def _protect(workload: str, namespace: str, state: Path) -> None:
    alive = {"ready": 0.0}
    async with Client(default_access(), listener=monitor_metrics.TRAFFIC) as client, asyncio.TaskGroup() as group:
        wakeups = Wakeups()
        gate_kind = registry.KINDS[os.environ.get(names.GATE_KIND_VARIABLE, registry.DEFAULT.kind)]
        view = ClusterView(client, namespace, workload, wakeups, gate_kind, _pod())
        pages: dict[str, Page] = {
            "/healthz": lambda: (200, "ok\n"),
            "/ready": lambda: (200, "ok\n") if alive["ready"] else (503, "starting\n"),
            "/metrics": lambda: (200, generate_latest(REGISTRY).decode()),
        }
        await serve(pages, names.METRICS_PORT)
        proof = await gate_kind.proof()
        reports = proof if isinstance(proof, MuxReports) else None
        await view.run(group)
        crash_points = CrashPoints(state)
        notices = Notices(PublishedStatus.adopt(view.object))
        fleet = PodControl(client, view, crash_points, notices)
        gate = GateControl(client, view, fleet, proof, crash_points, notices)
        recorder = Recorder(client, "understudy-monitor", os.environ.get("HOSTNAME", "monitor"))
        writer = StatusWriter(client, view, recorder, notices)
        image = os.environ.get(names.MONITOR_IMAGE_VARIABLE, "")
        notices.set_monitor(MonitorStatus(version=__version__, image=image, agent_protocol=KEYED_PROTOCOL))
        address = os.environ.get("UNDERSTUDY_POD_IP", "127.0.0.1")
        cluster, current = Cluster(view, fleet, gate), CurrentRecovery()
        roles = InstanceRoles(view, gate, current)
        agents = AgentConnections(client, view, address, crash_points, roles, wakeups, proof)
        meter = ResourceMeter(client, namespace, workload)
        observer = HealthObserver(meter, address, reports)
        black_box = BlackBox(view, observer, notices, RecordingArchive(state / "kept" / "recordings"))
        await serve(black_box.pages, names.RECORDINGS_PORT, host="127.0.0.1")
        readership = RobotReaders(view, observer, notices, address)
        parts = Parts(
            cluster=cluster,
            senses=Senses(observer, agents, proof, readership, roles, wakeups),
            state_manager=StateManager(observer.graph, StateStore(state / "kept"), agents, notices),
            journal=RecoveryJournal(Journal(state / "recovery.json"), crash_points),
            black_box=black_box,
            notices=notices,
        )
        diagnostics = DiagnosticsPublisher(view, observer, notices, lambda: parts.state_manager.taken)
        live_tree = LiveTreePages(view, observer, notices, lambda: diagnostics.problems)
        pages |= {"/": live_tree.page, "/tree": live_tree.tree}
        await end_at_start_if_deleted(view)
        monitor_loop = MonitorLoop(parts)
        schedule = monitor_loop.observe.schedule
        REGISTRY.register(
            monitor_metrics.ObservationMetrics(lambda: observer.records, lambda: (schedule.count, schedule.overruns))
        )
        permits = Permits(cluster, agents, observer.graph, current, wakeups, notices)
        group.create_task(end_if_deleted(view))
        group.create_task(keep_warm(client))
        group.create_task(permits.run())
        group.create_task(writer.run())
        group.create_task(meter.run())
        group.create_task(diagnostics.run())
        group.create_task(black_box.run())
        if reports is not None:
            group.create_task(observer.follow_writers())
            writes, reads = mux_messages.topics(namespace, workload)
            group.create_task(
                MuxOrders(
                    client,
                    view,
                    TextExchange(observer.graph, ArrivalWakeups(), reads=reads, writes=writes),
                    reports,
                    lambda: ready_names(fleet, agents, gate.state.active_uid),
                    lambda: observer.never_silent,
                    monitor_loop.act.safety,
                ).run()
            )
        else:
            group.create_task(readership.run())
        group.create_task(DeafnessWatch(fleet, gate, agents, observer, EndedFor(state / "deaf-for"), notices).run())
        socket = Path(os.environ.get("UNDERSTUDY_TASKS_SOCKET", f"{names.TASKS_DIR}/{names.TASKS_SOCKET}"))
        group.create_task(ActionProxyLink(socket, view, fleet, gate, agents, notices, observer).run())
        alive["ready"] = time.time()
        # The objects that exist now stay, and a garbage collection that visited them took up to 10 ms, also during a recovery.
        gc.collect()
        gc.freeze()
        _logger.info("watching %s in %s", workload, namespace)
        await monitor_loop.run()
