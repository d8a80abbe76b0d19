"""Says on ``/diagnostics`` how a workload is (REP 107). How such messages are told from evidence: see message_contents.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from rclpy.qos import QoSProfile

from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.trees.leaves.diagnostics import OWN, TOPIC, TYPE

_QOS = QoSProfile(depth=10)
"""Reliable and volatile, as diagnostic_updater's: what matches that matches this."""


class Status(NamedTuple):
    """A status as diagnostic_msgs/msg/DiagnosticStatus has it."""

    level: int
    name: str
    message: str
    hardware: str
    """What it is about, the same for as long as that is."""
    values: Sequence[tuple[str, str]]


class Diagnostics:
    """The publisher."""

    def __init__(self, graph: Graph) -> None:
        """Raises TypeNotInstalled."""
        self._graph = graph
        self._array = message_class(TYPE)
        self._status = message_class("diagnostic_msgs/msg/DiagnosticStatus")
        self._value = message_class("diagnostic_msgs/msg/KeyValue")
        self._publisher = graph.node.create_publisher(self._array, TOPIC, _QOS)

    @property
    def readers(self) -> int:
        """How many would receive it."""
        return int(self._publisher.get_subscription_count())

    def publish(self, status: Status, at: float) -> None:
        """Say it once, as it was at a time in Unix seconds."""
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
        """Leave the topic."""
        self._graph.node.destroy_publisher(self._publisher)
