"""Starts the nodes of nodes.py as processes of their own, and ends them."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
PACKAGE = HERE.parents[2] / "operator"


class Processes:
    """Nodes that run until the test is over."""

    def __init__(self) -> None:
        self._running: list[subprocess.Popen[str]] = []

    def node(self, *arguments: str, inside: Sequence[str] = (), **environment: str) -> subprocess.Popen[str]:
        """Start a role of nodes.py and wait until it says that it's ready; ``inside`` is a command to run it by."""
        process = subprocess.Popen(
            [*inside, sys.executable, str(HERE / "nodes.py"), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(PACKAGE), **environment},
        )
        self._running.append(process)
        assert self.line(process, 30) == "ready"
        return process

    @staticmethod
    def line(process: subprocess.Popen[str], timeout: float) -> str:
        """The next line that a process writes."""
        assert process.stdout is not None
        readable, _, _ = select.select([process.stdout], [], [], timeout)
        assert readable, f"{process.args} said nothing for {timeout} s"
        return process.stdout.readline().strip()

    def end(self) -> None:
        """Kill whatever still runs."""
        for process in self._running:
            process.kill()  # rclpy answers SIGTERM by itself and a stopped process doesn't at all
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe:
                    pipe.close()
