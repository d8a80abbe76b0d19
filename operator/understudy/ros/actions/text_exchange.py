"""Two topics of text in the robot's graph, on which two processes talk: each reads one and writes the other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.sample_taking import SampleTaker

_TYPE = "std_msgs/msg/String"
_DEPTH = 10


class TextExchange:
    """One side. For use in one thread."""

    def __init__(self, graph: Graph, wakeups: ArrivalWakeups, *, reads: str, writes: str) -> None:
        """Join both topics. A text that arrives wakes the process as a sample does."""
        self._class, self._taker, self._wakeups = message_class(_TYPE), SampleTaker(), wakeups
        self._subscription = graph.subscribe(reads, _TYPE, depth=_DEPTH, reliable=True)
        wakeups.add(self._subscription.handle)
        self._publisher: Any = graph.node.create_publisher(self._class, writes, QoSProfile(depth=_DEPTH))

    def received(self) -> Iterator[str]:
        """Yield the texts that arrived since the last call."""
        with self._subscription.handle:
            while (sample := self._taker.take(self._subscription.handle.pointer)) is not None:
                yield str(deserialize_message(sample.data, self._class).data)

    @contextmanager
    def receiving(self, receive: Callable[[str], None]) -> Iterator[None]:
        """Call a function with each text as it arrives, in the running event loop, until the context ends.

        For an exchange whose wakeups are used by nothing else.
        """

        def arrived() -> None:
            self._wakeups.clear()
            for text in self.received():
                receive(text)

        loop = asyncio.get_running_loop()
        loop.add_reader(self._wakeups.descriptor, arrived)
        try:
            yield
        finally:
            loop.remove_reader(self._wakeups.descriptor)

    def publish(self, text: str) -> None:
        """Publish a text."""
        self._publisher.publish(self._class(data=text))
