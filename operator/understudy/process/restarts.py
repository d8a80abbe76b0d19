"""Starts a process again as soon as it has ended.

A kubelet does that only once: it waits 10 s before the next start of a container, and up to five minutes later.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable

_logger = logging.getLogger(__name__)

STEADY = 5.0
"""Seconds that a process must have run to be started again. If it ends sooner, its environment is wrong, and the caller ends too."""


def keep_running(work: Callable[[], None]) -> int:
    """Run ``work`` in a child process until SIGTERM or SIGINT, and again whenever it has ended. Returns an exit code.

    The child has the modules that this process has imported, so it starts within milliseconds. It has a copy of the
    calling thread alone, so other threads of this process must be idle, such as those that numpy and rclpy start at
    their import.
    """
    waited = {signal.SIGTERM, signal.SIGINT, signal.SIGCHLD}
    signal.pthread_sigmask(signal.SIG_BLOCK, waited)
    stopped = False
    while True:
        started = time.monotonic()
        child = multiprocessing.get_context("fork").Process(target=_run, args=(work, waited))
        child.start()
        while child.is_alive():
            if signal.sigwait(waited) != signal.SIGCHLD:
                stopped = True
                child.terminate()
        code = child.exitcode or 0
        if stopped:
            return 0
        if not code or time.monotonic() - started < STEADY:
            return code if code >= 0 else 128 - code
        _logger.error("process %d has ended (%s) and is started again", child.pid, _reason(code))


def end_with_parent() -> None:
    """End this process as soon as the one that keeps it running has ended, so that nobody starts a second one beside it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        asyncio.get_running_loop().add_reader(parent.sentinel, os._exit, 1)


def _run(work: Callable[[], None], waited: set[signal.Signals]) -> None:
    signal.pthread_sigmask(signal.SIG_UNBLOCK, waited)
    work()


def _reason(code: int) -> str:
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"
