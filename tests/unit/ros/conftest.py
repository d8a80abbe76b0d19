"""Real DDS on this machine: a domain of its own, and the loopback only."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest

from tests.unit.ros.processes import Processes


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment that all nodes of a test share."""
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")  # heeded where the range isn't LOCALHOST
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for name in ("ROS_DISCOVERY_SERVER", "FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_STATIC_PEERS"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def processes(dds: None) -> Iterator[Processes]:
    """Nodes in processes of their own."""
    started = Processes()
    yield started
    started.end()


@pytest.fixture
def graph(dds: None) -> Iterator[object]:
    """This process's node."""
    from understudy.ros.graph import Graph

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
