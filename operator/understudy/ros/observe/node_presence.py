"""Checks at intervals which nodes the active instance has, from the ROS graph.

The graph's list of nodes does not contain their places, and instances of one workload have nodes of the same names. But
each endpoint has a GID, which identifies its host (Middleware.host_of), and the name of its node. Every node of rclcpp
and rclpy has a publisher of ``/parameter_events``, unless it is configured not to. In that case another of its
endpoints is observed for.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.observations import NodePresence

PERIOD = 0.1
"""Seconds between checks."""

AT_LEAST = 1.0
"""Seconds after which all publishers are examined even if their number is the same: a node may have taken another's
place. Counting them costs 6 us, examining those of 30 nodes 0.4 ms."""

EVENTS = "/parameter_events"


class NodePresenceWatch:
    """Whether some nodes are present. Times are Unix seconds."""

    def __init__(self, graph: Graph, counts: Callable[[bytes], bool]) -> None:
        """``counts`` returns whether the endpoint with a GID counts."""
        self._graph, self._counts = graph, counts
        self._seen: dict[str, NodePresence | None] = {}
        self._count = -1
        self._next = self._again = 0.0

    def follow(self, nodes: Iterable[str]) -> None:
        """Look for these nodes, by their fully qualified names, and no others."""
        self._seen = {name: self._seen.get(name) for name in nodes}
        self._next = self._again = 0.0

    def forget(self) -> None:
        """Forget all results, because other endpoints count now."""
        self._seen = dict.fromkeys(self._seen)
        self._next = self._again = 0.0

    def refresh(self) -> None:
        """Check, if that is due."""
        now = time.monotonic()
        if not self._seen or now < self._next:
            return
        self._next = now + PERIOD
        observed, count = time.time(), self._graph.publisher_count(EVENTS)
        if count == self._count and now < self._again:
            for seen in self._seen.values():
                if seen is not None:
                    self._seen[seen.node] = NodePresence(observed, seen.node, seen.there, seen.elsewhere)
            return
        ends = self._graph.publishers(EVENTS)
        # The name of a node arrives a moment after its first endpoint.
        settled = len(ends) == count and all(end.node for end in ends)
        self._count, self._again = count if settled else -1, now + AT_LEAST
        present: dict[str, bool] = {}
        for end in ends:
            present[end.node] = present.get(end.node, False) or self._counts(end.gid)
        for name in self._seen:
            if name not in present and (found := self._graph.endpoints_of(name)):
                present[name] = any(self._counts(end.gid) for end in found)
            self._seen[name] = NodePresence(observed, name, present.get(name, False), name in present)

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for seen in self._seen.values():
            if seen is not None:
                seen.received += seconds

    def of(self, name: str) -> NodePresence | None:
        """Return the last result for a node; None before the first check."""
        return self._seen.get(name)
