"""Looks now and then at which nodes the active instance has, by the ROS graph.

The graph's list of nodes does not say where a node is, and instances of one workload have nodes of the same names. Its
endpoints do: each has a GID that tells its host (Middleware.host_of), and the name of its node. Every node of rclcpp and rclpy
has a publisher of ``/parameter_events``, unless it was told not to; then another of its endpoints is looked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.observations import NodePresence

PERIOD = 0.1
"""Seconds between looks."""

AT_LEAST = 1.0
"""Seconds after which all publishers are gone through though their number is the same: a node may have taken another's
place. Counting them costs 6 us, going through those of 30 nodes 0.4 ms.
"""

EVENTS = "/parameter_events"


class NodePresenceWatch:
    """Whether some nodes are there. Times are Unix seconds."""

    def __init__(self, graph: Graph, counts: Callable[[bytes], bool]) -> None:
        """``counts`` says of a GID whether an endpoint of it does."""
        self._graph, self._counts = graph, counts
        self._seen: dict[str, NodePresence | None] = {}
        self._count = -1
        self._next = self._again = 0.0

    def follow(self, nodes: Iterable[str]) -> None:
        """Look for these nodes, fully qualified, and no others."""
        self._seen = {name: self._seen.get(name) for name in nodes}
        self._next = self._again = 0.0

    def forget(self) -> None:
        """Forget what was seen: other endpoints count now."""
        self._seen = dict.fromkeys(self._seen)
        self._next = self._again = 0.0

    def look(self) -> None:
        """Look, if it is time to."""
        now = time.monotonic()
        if not self._seen or now < self._next:
            return
        self._next = now + PERIOD
        looked, count = time.time(), self._graph.publisher_count(EVENTS)
        if count == self._count and now < self._again:
            for seen in self._seen.values():
                if seen is not None:
                    self._seen[seen.node] = NodePresence(looked, seen.node, seen.there, seen.elsewhere)
            return
        ends = self._graph.publishers(EVENTS)
        # The name of a node comes a moment after its first endpoint.
        settled = len(ends) == count and all(end.node for end in ends)
        self._count, self._again = count if settled else -1, now + AT_LEAST
        told: dict[str, bool] = {}
        for end in ends:
            told[end.node] = told.get(end.node, False) or self._counts(end.gid)
        for name in self._seen:
            if name not in told and (found := self._graph.endpoints_of(name)):
                told[name] = any(self._counts(end.gid) for end in found)
            self._seen[name] = NodePresence(looked, name, told.get(name, False), name in told)

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for seen in self._seen.values():
            if seen is not None:
                seen.received += seconds

    def of(self, name: str) -> NodePresence | None:
        """What the last look for a node found; None before the first."""
        return self._seen.get(name)
