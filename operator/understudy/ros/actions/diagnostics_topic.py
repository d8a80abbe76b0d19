"""Publishes the state of a workload on ``/diagnostics`` (REP 107).

How these messages are kept out of the evidence is described in message_contents.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from rclpy.qos import QoSProfile

from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.trees.leaves.diagnostics import OWN, TOPIC, TYPE

_QOS = QoSProfile(depth=10)
"""Reliable and volatile, like that of diagnostic_updater, so that its readers match this publisher too."""


class Status(NamedTuple):
    """A status, with the fields of diagnostic_msgs/msg/DiagnosticStatus."""

    level: int
    name: str
    message: str
    hardware: str
    """The subject of the status; it stays the same for as long as the subject does."""
    values: Sequence[tuple[str, str]]


class Diagnostics:
    """Publishes on ``/diagnostics``."""

    def __init__(self, graph: Graph) -> None:
        """Create the publisher. Raises TypeNotInstalled."""
        self._graph = graph
        self._array = message_class(TYPE)
        self._status = message_class("diagnostic_msgs/msg/DiagnosticStatus")
        self._value = message_class("diagnostic_msgs/msg/KeyValue")
        self._publisher = graph.node.create_publisher(self._array, TOPIC, _QOS)

    @property
    def readers(self) -> int:
        """Number of readers that would receive a message."""
        return int(self._publisher.get_subscription_count())

    def publish(self, status: Status, at: float) -> None:
        """Publish a status once, with its time in Unix seconds."""
        assert status.name.startswith(OWN), "or it would be taken for evidence"
        fraction, whole = math.modf(at)
        array = self._array()
        array.header.stamp.sec, array.header.stamp.nanosec = int(whole), int(fraction * 1e9)
        array.status = [
            self._status(
                level=bytes([status.level]),
                name=status.name,
                message=status.message,
                hardware_id=status.hardware,
                values=[self._value(key=key, value=value) for key, value in status.values],
            )
        ]
        self._publisher.publish(array)

    def close(self) -> None:
        """Remove the publisher."""
        self._graph.node.destroy_publisher(self._publisher)
