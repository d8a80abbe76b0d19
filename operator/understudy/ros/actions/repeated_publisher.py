"""Publishes a message repeatedly, from a publisher that the robot's reader has already discovered."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.message_values import to_message

_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,  # matches readers of either reliability
    durability=DurabilityPolicy.VOLATILE,
)


class Commander:
    """A publisher that is created before it is needed: until readers have matched, messages reach nobody."""

    def __init__(self, graph: Graph, topic: str, type_name: str, message: Mapping[str, Any]) -> None:
        """Create the publisher. Raises TypeNotInstalled and MessageError."""
        self._graph, self._class, self._values = graph, message_class(type_name), message
        to_message(self._class, message)
        self._publisher = graph.node.create_publisher(self._class, topic, _QOS)

    def publish(self) -> None:
        """Send the message once. Fields with the value ``now`` receive the current time."""
        self._publisher.publish(to_message(self._class, self._values))

    def close(self) -> None:
        """Remove the publisher."""
        self._graph.node.destroy_publisher(self._publisher)
