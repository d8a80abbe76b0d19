"""The task proxy's process: puts its parts together and ends them on SIGTERM."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import sys
from pathlib import Path

from understudy.action_proxy.goal_journal import GoalJournal
from understudy.action_proxy.monitor_socket import MonitorSocket
from understudy.action_proxy.proxy import Proxy
from understudy.api import names
from understudy.process import http_pages, json_logs
from understudy.ros.runtime.served_node import ServedNode

_logger = logging.getLogger(__name__)

STATE = Path("/var/lib/understudy")

HUNG = 20.0
"""Seconds without activity after which the thread that serves ROS counts as stuck. It blocks for a tenth of a second at
most."""


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT. The workload is named by UNDERSTUDY_WORKLOAD, its ROS graph by the environment."""
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    workload = os.environ.get("UNDERSTUDY_WORKLOAD")
    if argv or not workload:
        print(
            "understudy tasks: set the environment variable UNDERSTUDY_WORKLOAD; there are no arguments",
            file=sys.stderr,
        )
        return 2
    state = Path(os.environ.get("UNDERSTUDY_STATE", STATE)) / "tasks"
    state.mkdir(parents=True, exist_ok=True)
    socket = Path(os.environ.get("UNDERSTUDY_TASKS_SOCKET", f"{names.TASKS_DIR}/{names.TASKS_SOCKET}"))
    socket.unlink(missing_ok=True)  # left by an earlier proxy
    port = int(os.environ.get("UNDERSTUDY_TASKS_PORT", names.TASKS_PORT))
    asyncio.run(_run(workload, state, socket, port))
    return 0


def health(silent_for: float) -> tuple[int, str]:
    """Return the health page. The event loop answers it, and it reports whether the thread that serves ROS is stuck."""
    if silent_for > HUNG:
        return 503, f"the ROS thread has been stuck for {silent_for:.0f} s\n"
    return 200, "ok\n"


async def _run(workload: str, state: Path, socket: Path, port: int) -> None:
    loop = asyncio.get_running_loop()
    stop_requested = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop_requested.set)
    served = ServedNode("understudy_tasks_" + re.sub(r"[^a-zA-Z0-9_]", "_", workload))
    proxy = Proxy(served, GoalJournal(state / "goals.json"))
    talk = MonitorSocket(proxy.place, proxy.report)
    proxy.on_report = talk.send_state
    server = await talk.listen(socket)
    page = await http_pages.serve({"/healthz": lambda: health(served.silent_for)}, port)
    _logger.info("task proxy of %s", workload)
    await stop_requested.wait()
    server.close()
    page.close()
    await proxy.close()
    await served.close()
    _logger.info("ended")
