"""Real DDS on this machine: a domain of its own, and the loopback only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.unit.dds import keep_to_itself
from tests.unit.ros.processes import Processes


@pytest.fixture
def dds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment that all nodes of a test share."""
    keep_to_itself(monkeypatch)


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


@pytest.fixture
def watching(graph: Any) -> Iterator[object]:
    """Watches topics on the graph."""
    from understudy.ros.watching import Watching

    made = Watching(graph)
    yield made
    made.close()
