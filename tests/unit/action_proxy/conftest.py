"""Processes of nodes.py; a test can wait for their output lines."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
PACKAGE = HERE.parents[2] / "operator"
ACTION = "/goto"
TYPE = "test_msgs/action/Fibonacci"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


class Process:
    """A process and its output."""

    def __init__(self, command: Sequence[str], environment: dict[str, str]) -> None:
        self.events: list[dict[str, Any]] = []
        self.popen = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            try:
                self.events.append(json.loads(line))
            except ValueError:
                print(line, end="")

    def events_of(self, event: str, **fields: Any) -> list[dict[str, Any]]:
        """The lines of an event that have these fields."""
        return [e for e in list(self.events) if e.get("event") == event and fields.items() <= e.items()]

    def tell(self, line: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(f"{line}\n")
        self.popen.stdin.flush()

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait()


async def eventually(holds: Callable[[], Any], within: float = 60.0) -> Any:
    """Wait until the condition is true. Return its value."""
    end = time.monotonic() + within
    while not (value := holds()):
        assert time.monotonic() < end, f"not within {within} s"
        await asyncio.sleep(0.02)
    return value


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Real DDS on this machine: a domain of its own, and the loopback only."""
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for name in ("ROS_DISCOVERY_SERVER", "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_STATIC_PEERS"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def start(dds: None) -> Iterator[Callable[..., Process]]:
    """Starts nodes, by ``inside`` where they are to run elsewhere, and ends them with the test."""
    started: list[Process] = []

    def run(*arguments: str, inside: Sequence[str] = (), **environment: str) -> Process:
        command = [*inside, sys.executable, str(HERE / "nodes.py"), *arguments]
        started.append(Process(command, {**os.environ, **environment}))
        return started[-1]

    yield run
    for process in started:
        process.kill()
