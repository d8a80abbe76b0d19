"""Checks at intervals which endpoints publish topics, from the ROS graph."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.observations import Publishers

PERIOD = 0.1
"""Seconds between checks."""


class PublisherPresence:
    """The publishers of some topics. Times are Unix seconds."""

    def __init__(self, graph: Graph, counts: Callable[[bytes], bool]) -> None:
        """``counts`` returns whether the publisher with a GID counts."""
        self._graph, self._counts = graph, counts
        self._seen: dict[str, Publishers | None] = {}
        self._next = 0.0

    def follow(self, topics: Iterable[str]) -> None:
        """Check these topics and no others."""
        self._seen = {name: self._seen.get(name) for name in topics}
        self._next = 0.0

    def forget(self) -> None:
        """Forget all results, because other publishers count now."""
        self._seen = dict.fromkeys(self._seen)
        self._next = 0.0

    def refresh(self) -> None:
        """Check, if that is due."""
        now = time.monotonic()
        if not self._seen or now < self._next:
            return
        self._next = now + PERIOD
        for name in self._seen:
            observed = time.time()
            nodes = tuple(end.node for end in self._graph.publishers(name) if self._counts(end.gid))
            self._seen[name] = Publishers(observed, nodes)

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for seen in self._seen.values():
            if seen is not None:
                seen.received += seconds

    def of(self, name: str) -> Publishers | None:
        """Return the publishers of a topic at the last check; None before the first."""
        return self._seen.get(name)
