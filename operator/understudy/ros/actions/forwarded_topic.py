"""Forwards the samples of one topic from the writers of one partition or another to the robot's own readers, without deserializing them.

The subscription of this process is in the partitions of all instances, and its publisher in none, by the profiles of the process
(ros/dds/profiles.py). So each sends only to the side that it does not read from. One writer sends the samples of all instances, one
instance after the other. A reader never receives samples of one writer out of order, so it receives none of an earlier instance after the
first of a later one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.message_values import to_message
from understudy.ros.runtime.sample_taking import SampleTaker

DEPTH = 100
"""Samples that wait for this process, per topic: those of a second at 100 Hz, while the process stands still."""

HISTORY = 10
"""Samples that are kept for a reliable reader until it has acknowledged them: the usual depth of ROS."""


class ForwardedTopic:
    """The subscription and the publisher of one topic. For use in one thread."""

    def __init__(self, graph: Graph, topic: str, type_name: str, taker: SampleTaker, wakeups: ArrivalWakeups) -> None:
        """Begin to receive. Raises TypeNotInstalled and NotReceivable."""
        self.output = topic
        self._graph, self._type, self._taker, self._wakeups = graph, type_name, taker, wakeups
        self._class = message_class(type_name)
        self._reliable: bool | None = None
        self._subscription: Any = None
        self._offer: QoSProfile | None = None
        self._publisher: Any = None
        self.follow([])

    def counts(self) -> tuple[int, int]:
        """Return the numbers of its writers and readers, for a hundredth of the cost of listing them."""
        return self._graph.topic_counts(self.output)

    def writers(self) -> list[Endpoint]:
        """Return the writers of the topic besides this one."""
        return [end for end in self._graph.publishers(self.output) if end.node != self._graph.name]

    def follow(self, instances: Collection[bytes]) -> None:
        """Match the QoS that the instances' writers, given by their GIDs, offer, and that the robot's readers request.

        A subscription or publisher whose QoS changes is created again, and then must be discovered again. So follow them before they are
        needed.
        """
        offers = [qos for end, qos in self._graph.offers(self.output) if end.gid in instances]
        readers = [qos for end, qos in self._graph.requests(self.output) if end.node != self._graph.name]
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        if reliable != self._reliable:
            if self._subscription is not None:
                self._wakeups.forget(self._subscription.handle)
                self._graph.unsubscribe(self._subscription)
            self._subscription = self._graph.subscribe(self.output, self._type, depth=DEPTH, reliable=reliable)
            self._wakeups.add(self._subscription.handle)
            self._reliable = reliable
        offer = offered(readers)
        if offer != self._offer:
            if self._publisher is not None:
                self._graph.node.destroy_publisher(self._publisher)
            self._publisher = self._graph.node.create_publisher(
                self._class, self.output, offer, event_callbacks=PublisherEventCallbacks(use_default_callbacks=False)
            )
            self._offer = offer

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Take all samples that have arrived, and forward those that a function accepts by the GID of their writer. Returns their number.

        Raises TakeError and PublishError.
        """
        forwarded = 0
        with self._subscription.handle, self._publisher.handle:
            source, target = self._subscription.handle.pointer, self._publisher.handle.pointer
            while (sample := self._taker.take(source, with_data=False)) is not None:
                if forwards(sample.gid):
                    self._taker.publish(target)
                    forwarded += 1
        return forwarded

    def command(self, values: Mapping[str, Any]) -> None:
        """Send a message of this process, given by the values of its fields, from the same writer. Raises MessageError."""
        self._publisher.publish(to_message(self._class, values))

    def forget(self) -> None:
        """Nothing is held: the next message comes soon."""


def offered(readers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the QoS that matches all readers: reliable, and for each other policy the strictest that one of them requests."""
    latched = any(request.durability == DurabilityPolicy.TRANSIENT_LOCAL for request in readers)
    offer = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=HISTORY,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    # A request of 0 is one for nothing.
    if deadlines := [request.deadline for request in readers if request.deadline.nanoseconds]:
        offer.deadline = min(deadlines, key=lambda one: one.nanoseconds)
    leases = [request for request in readers if request.liveliness_lease_duration.nanoseconds]
    if leases:
        strictest = min(leases, key=lambda one: one.liveliness_lease_duration.nanoseconds)
        offer.liveliness, offer.liveliness_lease_duration = strictest.liveliness, strictest.liveliness_lease_duration
    return offer
