"""The operator's process: ``understudy operator``.

Both replicas watch, so that the one that takes over already knows the cluster. Only the holder of the Lease acts. If it
loses the lease, its process is replaced by a new one, because only that is certain to stop a write in progress.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from prometheus_client import generate_latest

from understudy.api import names
from understudy.api.quantities import amount
from understudy.controller.plan import MAX_MEMORY_LIMIT, MEMORY_LIMIT, Images
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.executor import MANAGER, Executor
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.controller.reconcile.observer import Observer
from understudy.controller.reconcile.policy_maps import PolicyMaps
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.reconcile.rollouts import PERCENT, Rollouts
from understudy.controller.reconcile.tree_judge import TreeJudge
from understudy.controller.runtime import kopf_handlers, watches
from understudy.controller.runtime.fleet_metrics import FleetMetrics
from understudy.controller.runtime.workers import Operator
from understudy.kube.client import SERVICE_ACCOUNT, Access, Client, Object
from understudy.kube.events import Recorder
from understudy.kube.kubeconfig import KubeconfigError, default_access, load_access
from understudy.kube.leader_election import LeadershipLost, Lease, Timing
from understudy.process import http_pages, json_logs, loop_turns
from understudy.process.tree_checker import TreeChecker

_logger = logging.getLogger(__name__)

LEASE = "understudy-operator"

LOST = 3
"""Exit status of an operator that lost its lease, after which the process starts again."""

_STALLED = "the operator has not been able to list its objects for too long: see its log\n"
_NOT_LISTED = "the operator has not listed all its objects yet\n"


@dataclass(frozen=True)
class Options:
    """Options of an operator."""

    images: Images
    lease_namespace: str
    lease: str = LEASE
    identity: str = field(default_factory=socket.gethostname)
    namespaces: tuple[str, ...] = ()
    """Namespaces to watch; empty for all."""
    resync_every: float = 30.0
    rollout_percent: int = PERCENT
    """Percentage of the workloads whose monitors may be replaced at the same time."""
    port: int = names.METRICS_PORT
    timing: Timing = field(default_factory=Timing)


async def run(access: Access, options: Options, *, stop: asyncio.Event | None = None) -> int:
    """Run an operator until ``stop`` is set, a signal arrives or the lease is lost, and return the exit status."""
    kopf_handlers.quiet()
    # A fleet's lists are long, and each watch of each namespace has a connection.
    async with Client(access, timeout=20, connections=0, listener=operator_metrics.TRAFFIC) as client:
        lease = Lease(client, options.lease_namespace, options.lease, options.identity, timing=options.timing)
        store, expectations = Store(), Expectations()
        policy_maps = PolicyMaps(client, store)
        reconciler = Reconciler(
            client,
            store,
            Observer(client, store, expectations, policy_maps),
            Executor(client, store, expectations, may_write=lambda: lease.held),
            Recorder(client, MANAGER, options.identity),
            options.images,
            Rollouts(store, percent=options.rollout_percent),
            TreeJudge(TreeChecker()),
        )
        operator = Operator(
            client,
            store,
            reconciler,
            namespaces=options.namespaces,
            resync_every=options.resync_every,
            policy_maps=policy_maps,
        )
        fleet = FleetMetrics(store, lambda: lease.held)
        operator_metrics.REGISTRY.register(fleet)
        pages: dict[str, http_pages.Page] = {
            "/healthz": lambda: (503, _STALLED) if operator.stalled else (200, "ok\n"),
            "/ready": lambda: (200, "ok\n") if operator.synced else (503, _NOT_LISTED),
            "/metrics": lambda: (200, generate_latest(operator_metrics.REGISTRY).decode()),
        }
        server = await http_pages.serve(pages, options.port, host=None)
        tasks = {
            asyncio.create_task(
                kopf_handlers.watch(operator.see, access, options.namespaces), name="watches of our own kinds"
            ),
            asyncio.create_task(watches.watch(client, operator.see, options.namespaces), name="watches"),
            asyncio.create_task(operator.keep_listing(), name="lists"),
            asyncio.create_task(lead(lease, operator), name="leading"),
        }
        if stop is not None:
            tasks.add(asyncio.create_task(_until(stop), name="stop"))
        try:
            return await _first(tasks)
        finally:
            operator_metrics.LEADER.set(0)
            operator_metrics.REGISTRY.unregister(fleet)
            await _cancel(tasks)
            await lease.release()
            server.close()


async def _until(stop: asyncio.Event) -> None:
    await stop.wait()


async def lead(lease: Lease, operator: Operator) -> None:
    """Acquire the lease, and work as the leader while it is held. Raises LeadershipLost."""
    await lease.acquire()
    async with asyncio.TaskGroup() as group:
        group.create_task(lease.keep())
        group.create_task(operator.lead())


async def _first(tasks: set[asyncio.Task[None]]) -> int:
    """Wait for the first task to end, and return the exit status: 0 if a signal ended the watches, LOST, or 1 if a task failed."""
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        error = task.exception() if not task.cancelled() else None
        if error is None:
            continue
        if isinstance(error, BaseExceptionGroup) and error.subgroup(LeadershipLost) is not None:
            _logger.error("%s; starting again", error.subgroup(LeadershipLost).exceptions[0])  # type: ignore[union-attr]
            return LOST
        _logger.error("%s ended", task.get_name(), exc_info=error)
        return 1
    return 0


async def _cancel(tasks: set[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def options(argv: Sequence[str]) -> tuple[argparse.Namespace, Options]:
    """Parse a command line, with the pod's environment as defaults."""
    environment = os.environ.get
    parser = argparse.ArgumentParser(
        prog="understudy operator",
        description="Reconciles RobotWorkloads, FailurePolicies and FallbackPools, while it holds the lease.",
        epilog="Exit status: 0 if the operator was stopped, 1 if one of its tasks failed, 2 if --monitor-image is missing. "
        "If it loses the lease, it starts again as a candidate.",
    )
    parser.add_argument(
        "--kubeconfig", help="kubeconfig to use instead of the pod's ServiceAccount (credential plugins are supported)"
    )
    parser.add_argument(
        "--monitor-image",
        default=environment(names.MONITOR_IMAGE_VARIABLE),
        metavar="IMAGE",
        help="image of monitors and agents; required, here or as UNDERSTUDY_MONITOR_IMAGE",
    )
    parser.add_argument(
        "--image-pull-policy",
        default=environment("UNDERSTUDY_IMAGE_PULL_POLICY", "IfNotPresent"),
        metavar="POLICY",
        help="pull policy of the monitor's image",
    )
    parser.add_argument(
        "--image-pull-secret",
        action="append",
        default=[],
        metavar="NAME",
        help="pull Secret for the monitor's image, in the workloads' namespaces; may be repeated",
    )
    parser.add_argument(
        "--priority-class",
        default=environment("UNDERSTUDY_PRIORITY_CLASS", ""),
        metavar="NAME",
        help="PriorityClass of the pods of monitors and discovery servers",
    )
    parser.add_argument(
        "--metrics-from",
        type=_peers,
        default=environment("UNDERSTUDY_METRICS_FROM", "[]"),
        metavar="PEERS",
        help="who may read the metrics of monitors: a JSON list of the peers of a NetworkPolicy "
        "(default: UNDERSTUDY_METRICS_FROM, or else nobody)",
    )
    parser.add_argument(
        "--memory-limit",
        type=_quantity,
        default=environment("UNDERSTUDY_MEMORY_LIMIT", MEMORY_LIMIT),
        metavar="QUANTITY",
        help="memory limit of each container of monitors, agents and discovery servers; empty for none "
        f"(default: UNDERSTUDY_MEMORY_LIMIT, or else {MEMORY_LIMIT})",
    )
    parser.add_argument(
        "--max-memory-limit",
        type=_amount,
        default=environment("UNDERSTUDY_MAX_MEMORY_LIMIT", MAX_MEMORY_LIMIT),
        metavar="QUANTITY",
        help="highest memory limit of a monitor whose policy lets it keep more than its limit allows "
        f"(default: UNDERSTUDY_MAX_MEMORY_LIMIT, or else {MAX_MEMORY_LIMIT})",
    )
    parser.add_argument(
        "--rollout-percent",
        type=_percent,
        default=environment("UNDERSTUDY_ROLLOUT_PERCENT", str(PERCENT)),
        metavar="PERCENT",
        help="percentage of the workloads whose monitors are replaced at the same time, as after an upgrade, rounded up "
        f"(default: UNDERSTUDY_ROLLOUT_PERCENT, or else {PERCENT})",
    )
    parser.add_argument(
        "--watch-namespace", action="append", default=[], help="watch this namespace only; may be repeated"
    )
    parser.add_argument(
        "--lease", default=LEASE, metavar="NAME", help="name of the Lease for leader election (default: %(default)s)"
    )
    parser.add_argument(
        "--lease-namespace",
        default=environment("UNDERSTUDY_NAMESPACE") or _own_namespace(),
        metavar="NAMESPACE",
        help="namespace of the Lease (default: the operator's own)",
    )
    parser.add_argument(
        "--identity",
        default=environment("POD_NAME") or socket.gethostname(),
        metavar="NAME",
        help="identity in the Lease (default: the pod's name)",
    )
    parser.add_argument(
        "--resync",
        type=float,
        default=30.0,
        metavar="SECONDS",
        help="seconds between two complete lists of all objects (default: %(default)g)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=names.METRICS_PORT,
        help="port of /healthz, /ready and /metrics (default: %(default)s)",
    )
    parser.add_argument(
        "--log-level",
        default=environment("UNDERSTUDY_LOG_LEVEL", "info"),
        metavar="LEVEL",
        help="debug, info, warning or error (default: UNDERSTUDY_LOG_LEVEL, or else info)",
    )
    parsed = parser.parse_args(argv)
    if not parsed.monitor_image:
        parser.error("--monitor-image (or UNDERSTUDY_MONITOR_IMAGE) is required: the image of monitors and agents")
    secrets = parsed.image_pull_secret or (environment("UNDERSTUDY_IMAGE_PULL_SECRETS") or "").split(",")
    watched = [n for n in parsed.watch_namespace or (environment("UNDERSTUDY_WATCH_NAMESPACES") or "").split(",") if n]
    return parsed, Options(
        images=Images(
            parsed.monitor_image,
            parsed.image_pull_policy,
            tuple(filter(None, secrets)),
            parsed.priority_class,
            parsed.metrics_from,
            parsed.memory_limit,
            parsed.max_memory_limit,
        ),
        lease_namespace=parsed.lease_namespace,
        lease=parsed.lease,
        identity=parsed.identity,
        namespaces=tuple(watched),
        resync_every=parsed.resync,
        rollout_percent=parsed.rollout_percent,
        port=parsed.port,
    )


def _percent(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 100:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 100")
    return int(text)


def _peers(text: str) -> tuple[Object, ...]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise argparse.ArgumentTypeError(f"{text:.100!r} is not JSON: {error}") from None
    if not isinstance(found, list) or not all(isinstance(peer, dict) for peer in found):
        raise argparse.ArgumentTypeError(f"{text:.100!r} is not a list of the peers of a NetworkPolicy")
    return tuple(found)


def _quantity(text: str) -> str:
    return _amount(text) if text else text


def _amount(text: str) -> str:
    try:
        amount(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _own_namespace() -> str:
    with contextlib.suppress(OSError):
        return Path(SERVICE_ACCOUNT, "namespace").read_text().strip()
    return "default"


def main(argv: Sequence[str]) -> int:
    """Run the operator, and return the exit status."""
    parsed, chosen = options(argv)
    json_logs.configure(parsed.log_level)
    try:
        access = load_access(parsed.kubeconfig) if parsed.kubeconfig else default_access()
    except KubeconfigError as error:
        print(f"understudy operator: {error}", file=sys.stderr)
        return 1
    status = loop_turns.run(run(access, chosen), operator_metrics.LONG_TURNS)
    sys.stderr.flush()
    if status == LOST:
        # A new process, so that nothing of the leader is left. The kubelet would wait for longer after each end.
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return status
