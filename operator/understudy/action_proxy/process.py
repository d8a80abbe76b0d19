"""The task proxy's process: puts its parts together and ends them on SIGTERM."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from collections import deque
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from understudy.action_proxy.control_state import ControlState
from understudy.action_proxy.goal_journal import GoalJournal, LastingCopy
from understudy.action_proxy.monitor_socket import MonitorSocket
from understudy.action_proxy.proxy import Proxy
from understudy.action_proxy.succession import OtherProxies
from understudy.api import names
from understudy.process import http_pages, json_logs
from understudy.ros.runtime.served_node import ServedNode

_logger = logging.getLogger(__name__)

STATE = Path("/var/lib/understudy")

OWN, LASTING = "tasks", "kept/tasks"
"""Folders of what lasts as long as the pod, and of what outlives it if the policy has a volume for kept state."""

HUNG = 20.0
"""Seconds without activity after which the thread that serves ROS counts as stuck. It blocks for a tenth of a second at
most."""


def main(argv: list[str]) -> int:
    """Run until SIGTERM or SIGINT, or until the proxy of another pod has replaced this one.

    UNDERSTUDY_NAMESPACE and UNDERSTUDY_WORKLOAD name the workload, the environment its ROS graph.
    """
    json_logs.configure(os.environ.get("UNDERSTUDY_LOG_LEVEL", "INFO"))
    workload = os.environ.get("UNDERSTUDY_WORKLOAD")
    if argv or not workload:
        print(
            "understudy tasks: set the environment variable UNDERSTUDY_WORKLOAD; there are no arguments",
            file=sys.stderr,
        )
        return 2
    state = Path(os.environ.get("UNDERSTUDY_STATE", STATE))
    (state / OWN).mkdir(parents=True, exist_ok=True)
    socket = Path(os.environ.get("UNDERSTUDY_TASKS_SOCKET", f"{names.TASKS_DIR}/{names.TASKS_SOCKET}"))
    socket.unlink(missing_ok=True)  # left by an earlier proxy
    port = int(os.environ.get("UNDERSTUDY_TASKS_PORT", names.TASKS_PORT))
    asyncio.run(_run(os.environ.get("UNDERSTUDY_NAMESPACE", ""), workload, state, socket, port))
    return 0


def health(silent_for: float) -> tuple[int, str]:
    """Return the health page. The event loop answers it, and it reports whether the thread that serves ROS is stuck."""
    if silent_for > HUNG:
        return 503, f"the ROS thread has been stuck for {silent_for:.0f} s\n"
    return 200, "ok\n"


async def _run(namespace: str, workload: str, state: Path, socket: Path, port: int) -> None:
    loop = asyncio.get_running_loop()
    stop_requested = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop_requested.set)
    served = ServedNode("understudy_tasks_" + names.in_ros(workload))
    page = await http_pages.serve({"/healthz": lambda: health(served.silent_for)}, port)
    others = OtherProxies(served, names.in_ros(f"{namespace}__{workload}"), state / OWN)
    stopping = asyncio.create_task(stop_requested.wait())
    reported: deque[ControlState] = deque(maxlen=1)
    talk = MonitorSocket(reported.append, lambda: {"tasks": [], "epoch": None})
    server = await talk.listen(socket)

    def deleted() -> bool:
        return bool(reported) and reported[-1].pod_deleted

    if await _done_before(stopping, others.until_serving(lambda: reported[-1].gate if reported else None, deleted)):
        journal = GoalJournal(state / OWN / "goals.json", LastingCopy(state / LASTING / "goals.json"))
        await journal.fetch()
        proxy = Proxy(served, journal)
        proxy.on_report = talk.send_state

        def place(situation: ControlState) -> None:
            reported.append(situation)
            proxy.place(situation)

        talk.hand_over(place, proxy.report)
        if reported:
            proxy.place(reported[-1])
        _logger.info("task proxy of %s", workload)
        await _done_before(stopping, others.until_replaced(proxy.serving_at, deleted))
        await proxy.close()
    server.close()
    page.close()
    await served.close()
    _logger.info("ended")


async def _done_before(stopping: asyncio.Task[Any], work: Coroutine[Any, Any, None]) -> bool:
    """Return whether some work ended before the process has to stop. Raises what the work raises."""
    task = asyncio.create_task(work)
    await asyncio.wait({task, stopping}, return_when=asyncio.FIRST_COMPLETED)
    if not task.done():
        task.cancel()
        return False
    task.result()
    return True
