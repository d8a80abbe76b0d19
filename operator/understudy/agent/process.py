"""The agent's process: puts its parts together and ends them on SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time

from understudy.agent.agent import Agent
from understudy.agent.control_channel import ControlChannel
from understudy.agent.pod_identity import PodIdentity
from understudy.api import names
from understudy.kube.gates.probes import ProbeSender
from understudy.process import cpu_scheduling, json_logs
from understudy.process.http_pages import serve
from understudy.ros.runtime.lean_imports import import_in_turn, rclpy_imported

_logger = logging.getLogger(__name__)

WITHOUT_MONITOR = 60.0
"""Seconds without any monitor after which probes stop: by then another host may have the monitor's address."""

_HOUSEKEEPING = 5.0  # seconds

_PROCEDURES = "understudy.trees.languages.short.procedure_loader"
_WARM = (
    "understudy.ros.observe.topic_watch",
    "understudy.ros.actions.instance_calls",
    "understudy.ros.runtime.service_client",
    "understudy.trees.languages.notations",
    _PROCEDURES,
)
_WARMING = f"import os; os.nice(19); import {', '.join(_WARM)}"


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT. The environment names the pod, see PodIdentity."""
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    if argv:
        print(f"understudy agent: unexpected {' '.join(argv)}; it takes no arguments", file=sys.stderr)
        return 2
    try:
        identity = PodIdentity.from_environment(os.environ)
        probes = ProbeSender(identity.uid)
    except ValueError as error:
        print(f"understudy agent: {error}", file=sys.stderr)
        return 2
    cpu_scheduling.ask_for_short_slices()
    asyncio.run(_run(identity, probes))
    return 0


async def _run(identity: PodIdentity, probes: ProbeSender) -> None:
    loop = asyncio.get_running_loop()
    stop_requested = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop_requested.set)
    agent = Agent(identity, probes)
    sessions = ControlChannel(agent)
    agent.publish = sessions.publish
    agent.isolation.contacts = sessions

    def ready() -> tuple[int, str]:
        status = agent.status()
        return (200, "ready\n") if status.ready else (503, f"{status.phase}: {status.reason}\n")

    pages = {"/ready": ready, "/healthz": lambda: (200, "ok\n")}
    control = await sessions.serve(int(os.environ.get(names.AGENT_PORT_VARIABLE, names.AGENT_PORT)))
    health = await serve(pages, int(os.environ.get(names.AGENT_HEALTH_PORT_VARIABLE, names.AGENT_HEALTH_PORT)))
    probes.run()
    await agent.begin()
    _logger.info("agent of %s%s", identity.pod, ", held" if agent.held else "")
    housekeeping = [
        asyncio.create_task(stop_probes_without_monitor(sessions, probes)),
        asyncio.create_task(agent.isolation.run(), name="fence"),
    ]
    # A recovery may need these modules at any time, so they are imported now. Other requests do not wait for that.
    housekeeping.append(asyncio.create_task(_warm() if agent.held else _imported(_PROCEDURES)))
    await stop_requested.wait()
    for task in housekeeping:
        task.cancel()
    for server in (control, health):
        server.close()
    probes.close()
    await agent.end()
    _logger.info("ended")


async def stop_probes_without_monitor(sessions: ControlChannel, probes: ProbeSender) -> None:
    """Stop the probes after a while without a monitor; runs until cancelled."""
    last = time.monotonic()
    while True:
        if sessions.count:
            last = time.monotonic()
        elif time.monotonic() - last > WITHOUT_MONITOR:
            probes.rest()
        await asyncio.sleep(_HOUSEKEEPING)


async def _warm() -> None:
    """Import ROS early: when the pod is claimed, the start of the instance needs all of the CPU.

    First a process without priority imports it and ends, so that the files are in the node's page cache.
    """
    with contextlib.suppress(OSError):
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            _WARMING,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        try:
            await process.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
    await rclpy_imported()
    await _imported(*_WARM)


async def _imported(*modules: str) -> None:
    for module in modules:
        await asyncio.to_thread(import_in_turn, module)
