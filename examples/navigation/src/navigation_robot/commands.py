"""Commands as they arrive, with who sent them and when the middleware received them.

A Twist does not say who sent it, and two instances of one navigation stack send the same. The GID of the DDS writer
tells them apart, and its first four bytes the host (understudy.ros.dds.host_ids says how), which in a cluster is the pod. rclpy
drops it, so the queue is read with Understudy's reader. That is for the log alone: the robot drives by the commands of
whoever gets through to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from understudy.ros.dds.host_ids import HOST
from understudy.ros.runtime.sample_taking import SampleTaker

DEPTH = 50
"""Commands that wait to be taken; more than two seconds' of any controller."""


class Command(NamedTuple):
    """One command. Times are Unix seconds."""

    received: float
    sent: float
    source: str
    """The host that the sender runs on: vendor and host id of its GID, in hexadecimal."""
    writer: str
    """The sender itself: its whole GID."""
    linear: float
    angular: float


class Received(NamedTuple):
    """A message, and who sent it, as a command has it."""

    received: float
    sent: float
    source: str
    writer: str
    message: Any


class Ear:
    """A robot's ear on one topic. No executor may spin its node: it would take the messages."""

    def __init__(self, node: Node, kind: type, topic: str) -> None:
        self._kind = kind
        self._subscription = node.create_subscription(kind, topic, lambda _: None, DEPTH)
        self._taker = SampleTaker()

    def take(self) -> Iterator[Received]:
        """What has arrived since the last time."""
        handle = self._subscription.handle
        with handle:
            while (sample := self._taker.take(handle.pointer)) is not None:
                message = deserialize_message(sample.data, self._kind)
                yield Received(sample.received, sample.sent, sample.gid[HOST].hex(), sample.gid.hex(), message)


class Commands:
    """The robot's ear on /cmd_vel."""

    def __init__(self, node: Node, topic: str = "/cmd_vel") -> None:
        self._ear = Ear(node, Twist, topic)

    def take(self) -> Iterator[Command]:
        """What has arrived since the last time."""
        for *sender, twist in self._ear.take():
            yield Command(*sender, twist.linear.x, twist.angular.z)
