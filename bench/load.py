"""Keeps all cores busy with one process for each, at the bench's own priority. They end with the bench, however it
ends."""

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
    """Busy processes for the duration of the context."""

    def __init__(self, count: int | None = None) -> None:
        """``count`` is the number of processes; the default is the number of cores."""
        self.count = count if count is not None else os.cpu_count() or 1
        self._running: list[subprocess.Popen[bytes]] = []
        self._begun = self._used = 0.0

    def __enter__(self) -> Load:
        for _ in range(self.count):
            self._running.append(subprocess.Popen([sys.executable, "-c", _BUSY % os.getpid()]))
        time.sleep(1.0)  # until they compute
        self._begun, self._used = time.monotonic(), processor_seconds()[0]
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running:
            process.kill()
        for process in self._running:
            process.wait()

    def busy(self) -> float:
        """Return the percentage of the available processor time that was used since the start."""
        passed = time.monotonic() - self._begun
        return 100 * (processor_seconds()[0] - self._used) / (passed * (os.cpu_count() or 1))

    def note(self) -> str:
        """Describe the load, for the report."""
        return (
            f"{self.count} processes that compute SHA-256 without a pause on {os.cpu_count()} cores, which were "
            f"{self.busy():.0f} % busy; all processes {priority()}"
        )


def priority() -> str:
    """Describe how this process and its children are scheduled, and how that differs from a pod, if it does."""
    policy, nice = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    said = f"{_POLICIES.get(policy, f'policy {policy}')}, nice {nice}"
    normal = policy == os.SCHED_OTHER and nice == 0
    return said if normal else f"{said}: THIS IS NOT HOW A POD RUNS, TIMES MEAN NOTHING"
