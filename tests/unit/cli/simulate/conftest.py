"""Real DDS on this machine: a domain of its own, and the loopback only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.unit.dds import isolate_discovery


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A node of the test's own."""
    isolate_discovery(monkeypatch)
    from understudy.ros.runtime.graph_node import Graph

    made = Graph("application")
    yield made
    made.close()
