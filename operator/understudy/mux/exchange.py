"""The two topics on which a mux receives orders and publishes reports."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from understudy.api import names
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.sample_taking import SampleTaker

_TYPE = "std_msgs/msg/String"
_DEPTH = 10


def topics(namespace: str, workload: str) -> tuple[str, str]:
    """Return the topics of the orders and of the reports of a workload."""
    place = "/understudy/" + "/".join(map(names.in_ros, (namespace, workload)))
    return f"{place}/mux_orders", f"{place}/mux_reports"


class Exchange:
    """The mux's side. For use in one thread."""

    def __init__(
        self, graph: Graph, namespace: str, workload: str, taker: SampleTaker, wakeups: ArrivalWakeups
    ) -> None:
        """Join both topics. A text that arrives wakes the process as a sample does."""
        orders, reports = topics(namespace, workload)
        self._class, self._taker = message_class(_TYPE), taker
        self._subscription = graph.subscribe(orders, _TYPE, depth=_DEPTH, reliable=True)
        wakeups.add(self._subscription.handle)
        self._publisher: Any = graph.node.create_publisher(self._class, reports, QoSProfile(depth=_DEPTH))

    def received(self) -> Iterator[str]:
        """Yield the texts that arrived on the topic of the orders."""
        with self._subscription.handle:
            while (sample := self._taker.take(self._subscription.handle.pointer)) is not None:
                yield str(deserialize_message(sample.data, self._class).data)

    def publish(self, text: str) -> None:
        """Publish a report."""
        self._publisher.publish(self._class(data=text))
