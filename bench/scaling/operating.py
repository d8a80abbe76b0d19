"""The operator as a measured process: its processor time and memory by the kernel's account, and its own metrics."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path

from bench.scaling.cluster import REPOSITORY, SYSTEM
from bench.scaling.exposition import Reading, read
from bench.scaling.fleets import IMAGE

QUEUE, RESYNCED, LEADER = "understudy_queue_length", "understudy_last_resync_timestamp_seconds", "understudy_leader"
RECONCILED, MISSED = "understudy_reconciliations_total", "understudy_watch_missed_total"
RESYNC = "understudy_last_resync_seconds"
NAMES = frozenset({QUEUE, RESYNCED, LEADER, RECONCILED, MISSED, RESYNC})
SAMPLE = 0.5
"""Seconds between two samples of its memory, and checks whether it runs."""

BACKOFF_FIRST, BACKOFF_MOST = 10.0, 300.0
"""Seconds until the operator is started again after another end, as by a kubelet. The first time it is started at once.
"""

PROGRAM = """
import sys
sys.modules["kubernetes"] = sys.modules["kubernetes_asyncio"] = None
from understudy.main import main
sys.exit(main())
"""
"""Runs ``understudy`` as in its image: kopf imports these clients if they are installed, which takes 75 MB, and only
tests need them."""


@dataclass
class Usage:
    """The use of resources between two times."""

    seconds: float
    cpu: float
    """Seconds of processor time."""
    memory: list[float] = field(default_factory=list)
    """Resident memory in MB, at each sample."""

    @property
    def milli(self) -> float:
        """Mean milli-CPU."""
        return 1000 * self.cpu / self.seconds


class Operator:
    """The operator for the duration of the context. If it ends by itself, it is started again, as its Deployment's
    kubelet would."""

    def __init__(self, kubeconfig: Path, log: Path) -> None:
        self._kubeconfig, self._log = kubeconfig, log
        self._port = _free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self._used = 0.0
        self.restarts = 0
        self._memory: list[float] = []
        self._ended = threading.Event()
        self._keeping = threading.Thread(target=self._keep, daemon=True)

    def __enter__(self) -> Operator:
        self._process = self._start()
        self._keeping.start()
        return self

    def _start(self) -> subprocess.Popen[bytes]:
        command = [
            sys.executable, "-c", PROGRAM, "operator", "--kubeconfig", str(self._kubeconfig),
            "--monitor-image", IMAGE, "--lease-namespace", SYSTEM, "--identity", f"bench-{time.time():.0f}",
            "--port", str(self._port), "--log-level", "warning",
        ]  # fmt: skip
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "operator"), "NO_PROXY": "*"}
        with self._log.open("ab") as out:
            return subprocess.Popen(command, env=environment, stdout=out, stderr=out)

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._keeping.join()
        assert self._process is not None
        self._process.terminate()  # the operator releases its lease
        try:
            self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def metrics(self) -> Reading | None:
        """Return the operator's own metrics; None if it does not answer."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=10) as answer:
                return read(answer.read().decode(), NAMES)
        except (OSError, urllib.error.URLError):
            return None

    @property
    def idle(self) -> bool:
        """Whether the operator leads, has listed everything and has nothing left to process."""
        found = self.metrics()
        if found is None or not found.total(LEADER) or not found.total(RESYNCED):
            return False
        return found.total(RECONCILED) > 0 and found.total(QUEUE) == 0

    def measure(self) -> Measure:
        """Begin to measure."""
        return Measure(self)

    def cpu(self) -> float:
        """Return the processor time so far in seconds, including that of processes that have ended."""
        return self._used + self._own_cpu()

    def _own_cpu(self) -> float:
        assert self._process is not None
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory(self) -> float:
        """Return the resident memory in MB."""
        assert self._process is not None
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) * 1024 / 1e6

    @property
    def samples(self) -> list[float]:
        """All samples of the operator's memory so far."""
        return self._memory

    def _keep(self) -> None:
        """Sample the operator's memory, and start it again after it has ended, with increasing delays."""
        assert self._process is not None
        again = 0.0
        while not self._ended.wait(SAMPLE):
            # WNOWAIT leaves the process unreaped, so that its processor time can still be read.
            if os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
                with contextlib.suppress(OSError, IndexError):
                    self._memory.append(self.memory())
                continue
            used = self._own_cpu()
            self._ended.wait(again)
            again = min(2 * again or BACKOFF_FIRST, BACKOFF_MOST)
            if not self._ended.is_set():
                self._process.wait()
                self._process, self._used = self._start(), self._used + used
                self.restarts += 1


class Measure:
    """Measures the operator's use of resources from now on."""

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._begun, self._cpu, self._first = time.monotonic(), operator.cpu(), len(operator.samples)

    def end(self) -> Usage:
        """Return the use so far."""
        memory = self._operator.samples[self._first :] or [self._operator.memory()]
        return Usage(time.monotonic() - self._begun, self._operator.cpu() - self._cpu, memory)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port
