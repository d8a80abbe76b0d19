"""Checks at intervals which endpoints publish topics, and which nodes the active instance has, from the ROS graph.

The graph's list of nodes does not contain their places, and instances of one workload have nodes of the same names. But
each endpoint has a GID, which identifies its host (Middleware.host_of), and the name of its node. Every node of rclcpp
and rclpy has a publisher of ``/parameter_events``, unless it is configured not to. In that case another of its
endpoints is looked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from understudy.ros.runtime.graph_node import Graph
from understudy.trees.core.observations import Evidence, NodePresence, Publishers

PERIOD = 0.1
"""Seconds between checks."""

AT_LEAST = 1.0
"""Seconds after which all publishers are examined even if their number is the same: a node may have taken another's
place. Counting them costs 6 us, examining those of 30 nodes 0.4 ms."""

EVENTS = "/parameter_events"

Seen = TypeVar("Seen", bound=Evidence)


class _GraphChecks(Generic[Seen]):
    """The last results of checks, by name. Times are Unix seconds."""

    def __init__(self, graph: Graph, counts: Callable[[bytes], bool]) -> None:
        """``counts`` returns whether the endpoint with a GID counts."""
        self._graph, self._counts = graph, counts
        self._records: dict[str, Seen | None] = {}
        self._next = self._again = 0.0

    def follow(self, names: Iterable[str]) -> None:
        """Check these names, fully qualified, and no others."""
        self._records = {name: self._records.get(name) for name in names}
        self._next = self._again = 0.0

    def forget(self) -> None:
        """Forget all results, because other endpoints count now."""
        self._records = dict.fromkeys(self._records)
        self._next = self._again = 0.0

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        for record in self._records.values():
            if record is not None:
                record.received += seconds

    def of(self, name: str) -> Seen | None:
        """Return the last result for a name; None before the first check."""
        return self._records.get(name)

    def _is_due(self, now: float) -> bool:
        if not self._records or now < self._next:
            return False
        self._next = now + PERIOD
        return True


class PublisherPresence(_GraphChecks[Publishers]):
    """The publishers of some topics."""

    def refresh(self) -> None:
        """Check, if that is due."""
        if not self._is_due(time.monotonic()):
            return
        for name in self._records:
            observed = time.time()
            nodes = tuple(end.node for end in self._graph.publishers(name) if self._counts(end.gid))
            self._records[name] = Publishers(observed, nodes)


class NodePresenceWatch(_GraphChecks[NodePresence]):
    """Whether some nodes are present."""

    _count = -1
    """The number of endpoints at the last complete check."""

    def refresh(self) -> None:
        """Check, if that is due."""
        now = time.monotonic()
        if not self._is_due(now):
            return
        observed, count = time.time(), self._graph.publisher_count(EVENTS)
        if count == self._count and now < self._again:
            for record in self._records.values():
                if record is not None:
                    self._records[record.node] = NodePresence(observed, record.node, record.there, record.elsewhere)
            return
        ends = self._graph.publishers(EVENTS)
        # The name of a node arrives a moment after its first endpoint.
        settled = len(ends) == count and all(end.node for end in ends)
        self._count, self._again = count if settled else -1, now + AT_LEAST
        present: dict[str, bool] = {}
        for end in ends:
            present[end.node] = present.get(end.node, False) or self._counts(end.gid)
        for name in self._records:
            if name not in present and (found := self._graph.endpoints_of(name)):
                present[name] = any(self._counts(end.gid) for end in found)
            self._records[name] = NodePresence(observed, name, present.get(name, False), name in present)
