"""Keeps all cores busy: one process for each, of the bench's own priority, which end with it however it ends."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from bench.results import processor_seconds

_BUSY = """
import ctypes, hashlib, os, signal
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
block = bytes(65536)
while os.getppid() == %d:
    for _ in range(100):
        hashlib.sha256(block).digest()
"""

_POLICIES = {
    os.SCHED_OTHER: "SCHED_OTHER",
    os.SCHED_BATCH: "SCHED_BATCH",
    os.SCHED_IDLE: "SCHED_IDLE",
    os.SCHED_FIFO: "SCHED_FIFO",
    os.SCHED_RR: "SCHED_RR",
}


class Load:
    """Busy processes between ``with`` and its end."""

    def __init__(self, count: int | None = None) -> None:
        """As many as there are cores, where ``count`` isn't given."""
        self.count = count if count is not None else os.cpu_count() or 1
        self._running: list[subprocess.Popen[bytes]] = []
        self._begun = self._used = 0.0

    def __enter__(self) -> Load:
        for _ in range(self.count):
            self._running.append(subprocess.Popen([sys.executable, "-c", _BUSY % os.getpid()]))
        time.sleep(1.0)  # until they are at it
        self._begun, self._used = time.monotonic(), processor_seconds()[0]
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running:
            process.kill()
        for process in self._running:
            process.wait()

    def busy(self) -> float:
        """Percent of the available processor time that was used since its start."""
        passed = time.monotonic() - self._begun
        return 100 * (processor_seconds()[0] - self._used) / (passed * (os.cpu_count() or 1))

    def note(self) -> str:
        """What it is, for the report."""
        return (
            f"{self.count} processes that compute SHA-256 without a pause on {os.cpu_count()} cores, which were "
            f"{self.busy():.0f} % busy; all processes {priority()}"
        )


def priority() -> str:
    """How this process, and so those that it starts, is scheduled; what that means where it isn't as in a pod."""
    policy, nice = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    said = f"{_POLICIES.get(policy, f'policy {policy}')}, nice {nice}"
    normal = policy == os.SCHED_OTHER and nice == 0
    return said if normal else f"{said}: THIS IS NOT HOW A POD RUNS, TIMES MEAN NOTHING"
