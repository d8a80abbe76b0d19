"""Starts the nodes of nodes.py as processes of their own, and ends them."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
PACKAGE = HERE.parents[2] / "operator"
MIDDLEWARE = "\x1b["


class Processes:
    """Nodes that run until the test is over."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[str]] = []

    def node(
        self, *arguments: str, inside: Sequence[str] = (), script: str = "nodes.py", **environment: str
    ) -> subprocess.Popen[str]:
        """Start a role of nodes.py, or of another script here, and wait until it says that it's ready; ``inside`` is a command
        to run it by.
        """
        process = self.start([*inside, sys.executable, str(HERE / script), *arguments], **environment)
        assert self.line(process, 30) == "ready"
        return process

    def start(self, command: Sequence[str], **environment: str) -> subprocess.Popen[str]:
        """Start a command with this environment added to the test's."""
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{PACKAGE}{os.pathsep}{HERE.parents[2]}", **environment},
        )
        self._running.append(process)
        return process

    @staticmethod
    def line(process: subprocess.Popen[str], timeout: float) -> str:
        """The next line that a process writes, but for what its middleware has to say (in colours, on the same pipe)."""
        end = time.monotonic() + timeout
        while (line := _line(process, end)).startswith(MIDDLEWARE):
            print(line)
        return line

    def end(self) -> None:
        """Kill whatever still runs."""
        for process in self._running:
            process.kill()  # rclpy answers SIGTERM by itself and a stopped process doesn't at all
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe:
                    pipe.close()


def _line(process: subprocess.Popen[str], end: float) -> str:
    """Read without a buffer: what it held wouldn't be seen by the next wait."""
    assert process.stdout is not None
    line = bytearray()
    while not line.endswith(b"\n"):
        readable, _, _ = select.select([process.stdout], [], [], max(end - time.monotonic(), 0.0))
        assert readable, f"{process.args} said no more than {line.decode()!r}"
        byte = os.read(process.stdout.fileno(), 1)
        if not byte:
            break
        line += byte
    return line.decode().strip()
