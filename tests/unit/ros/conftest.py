"""Real DDS on this machine: a domain of its own, and the loopback only."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.dds import isolate_discovery
from tests.unit.ros.processes import PACKAGE, Processes

SERVER = PACKAGE.parent / "docker" / "understudy-discovery-server"


def kill(server: subprocess.Popen[bytes]) -> None:
    """Kill a discovery server with the process that supervises it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGKILL)
    server.wait()


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment that all nodes of a test share."""
    isolate_discovery(monkeypatch)


@pytest.fixture
def processes(dds: None) -> Iterator[Processes]:
    """Nodes in processes of their own."""
    started = Processes()
    yield started
    started.end()


@pytest.fixture
def discovery_server(
    dds: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Starts a server, at the same address as any before, that participants made from then on know."""
    with contextlib.ExitStack() as stack:
        free = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for one in free:
            one.bind(("127.0.0.1", 0))
        port, asked = (one.getsockname()[1] for one in free)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    started: list[subprocess.Popen[bytes]] = []
    environment = {
        **os.environ,
        "UNDERSTUDY_ENVIRONMENT": sys.prefix,
        "HOME": str(tmp_path),
        "PYTHONPATH": str(PACKAGE),
        "UNDERSTUDY_DISCOVERY_ASKED": str(asked),
    }

    def server() -> subprocess.Popen[bytes]:
        command = [SERVER, "127.0.0.1", str(port)]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, start_new_session=True)
        started.append(process)
        return process

    monkeypatch.setenv("ROS_DISCOVERY_SERVER", f"127.0.0.1:{port}")
    yield server
    for process in started:
        kill(process)


@pytest.fixture
def graph(dds: None) -> Iterator[object]:
    """This process's node."""
    from understudy.ros.runtime.graph_node import Graph

    made = Graph("tested")
    yield made
    made.close()


@pytest.fixture
def eventually() -> Callable[..., None]:
    """Wait until something holds."""
    import time

    def wait(holds: Callable[[], object], timeout: float = 20) -> None:
        end = time.monotonic() + timeout
        while not holds():
            assert time.monotonic() < end, f"{timeout} s were not enough"
            time.sleep(0.02)

    return wait


@pytest.fixture
def address_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[bytes], str]:
    """Gives a host, by its part of a GID, one IPv4 address: this machine may have several, or none."""
    from understudy.ros.rmw import MIDDLEWARE

    real, hosts = MIDDLEWARE.host_at, {}
    monkeypatch.setattr(MIDDLEWARE, "host_at", lambda address: hosts.get(address) or real(address))

    def address(host: bytes) -> str:
        free_address = f"192.0.2.{100 + len(hosts)}"
        hosts[free_address] = host
        return free_address

    return address


@pytest.fixture
def watching(graph: Any) -> Iterator[object]:
    """Watches topics on the graph."""
    from understudy.ros.observe.topic_watch import TopicWatch

    made = TopicWatch(graph)
    yield made
    made.close()
