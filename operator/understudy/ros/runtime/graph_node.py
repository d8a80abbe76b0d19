"""This process's place in the ROS graph: one node, which is never spun.

Subscriptions are drained (topic_watch.py), so no executor runs; the node offers no services, since nobody would answer
them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.node_options import own_context, plain_node


class NotReceivable(RuntimeError):
    """A topic cannot be received as a type, by its name or by what else this process has of that topic; the text says why."""


@dataclass(frozen=True)
class Endpoint:
    """A writer or reader that discovery knows of."""

    type: str
    gid: bytes
    node: str
    """Fully qualified; empty until the node's own announcement has come."""
    latched: bool = False
    """Whether it is a writer that gives its last messages to those who join late (transient local)."""


class Crossing(Protocol):
    """What goes between a workload and its robot: a topic, service or action, with None for the others."""

    @property
    def topic(self) -> str | None:
        """Fully qualified, like the others."""

    @property
    def service(self) -> str | None:
        """Whichever side serves it."""

    @property
    def action(self) -> str | None:
        """Whichever side serves it."""


class Graph:
    """One node and what it can see."""

    def __init__(self, name: str, *, domain_id: int | None = None) -> None:
        """Join the graph as node ``name``; ``domain_id`` is ROS_DOMAIN_ID where it is not given."""
        for variable, value in MIDDLEWARE.introspection.items():
            os.environ.setdefault(variable, value)
        self._context = own_context(domain_id=domain_id)
        self.node = plain_node(name, self._context)

    def subscribe(
        self, topic: str, type_name: str, *, depth: int, latched: bool = False, reliable: bool = False
    ) -> Any:
        """A subscription that matches every publisher: best effort, volatile, the last ``depth`` samples kept.

        With ``latched`` it matches those that are reliable and transient local, and is given what they had said before; with
        ``reliable`` those that are, of which it misses nothing.
        Raises TypeNotInstalled and NotReceivable.
        """
        try:
            message = message_class(type_name)
        except ValueError as error:  # whoever publishes by DDS alone calls its types as it likes
            raise NotReceivable(f"{topic} cannot be received: {error}") from error
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if latched or reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        try:
            return self.node.create_subscription(
                message,
                topic,
                _never_called,
                qos,
                raw=True,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
        except RuntimeError as error:  # of rclpy; one process has a topic as one type
            raise NotReceivable(
                f"{topic} cannot be received as {type_name}: everything that uses the topic in this process must use one type ({error})"
            ) from error

    def unsubscribe(self, subscription: Any) -> None:
        """End a subscription."""
        self.node.destroy_subscription(subscription)

    def publishers(self, topic: str) -> list[Endpoint]:
        """The publishers of a topic."""
        return _endpoints(self.node.get_publishers_info_by_topic(topic))

    def offered(self, topic: str) -> list[QoSProfile]:
        """What each publisher of a topic offers."""
        return [info.qos_profile for info in self.node.get_publishers_info_by_topic(topic)]

    def publisher_count(self, topic: str) -> int:
        """How many publishers a topic has: a hundredth of the work of looking at them."""
        return int(self.node.count_publishers(topic))

    def endpoints_of(self, node: str) -> list[Endpoint]:
        """Publishers and subscribers of a node, or of several of that full name: those of one of its topics, if it has any."""
        namespace, _, name = node.rpartition("/")
        try:
            published = self.node.get_publisher_names_and_types_by_node(name, namespace or "/")
            read = self.node.get_subscriber_names_and_types_by_node(name, namespace or "/")
        except NodeNameNonExistentError:
            return []
        topics = [
            *((topic, self.publishers) for topic, _ in published),
            *((topic, self.subscribers) for topic, _ in read),
        ]
        looks = ([end for end in ends(topic) if end.node == node] for topic, ends in topics)
        return next((found for found in looks if found), [])

    def subscribers(self, topic: str) -> list[Endpoint]:
        """The subscribers of a topic, this process's own among them."""
        return _endpoints(self.node.get_subscriptions_info_by_topic(topic))

    def type_of(self, topic: str) -> str | None:
        """The type that a topic's publishers announce; None if there are none, or where they disagree."""
        types = {endpoint.type for endpoint in self.publishers(topic)}
        return types.pop() if len(types) == 1 else None

    def servers(self, service: str) -> list[Endpoint]:
        """What takes the requests of a service."""
        return _endpoints(self.node.get_subscriptions_info_by_topic(f"rq{service}Request", no_mangle=True))

    def endpoints(self, output: Crossing) -> list[Endpoint]:
        """What workloads (and robots, for services and actions) have opened for an output.

        Publishers of a topic; servers and clients of a service, and of an action by its send_goal service. Which of
        them are a pod's own, their GIDs tell.
        """
        if output.topic:
            return self.publishers(output.topic)
        service = output.service or f"{output.action}/_action/send_goal"
        requests = f"rq{service}Request"
        readers = self.node.get_subscriptions_info_by_topic(requests, no_mangle=True)
        writers = self.node.get_publishers_info_by_topic(requests, no_mangle=True)
        return _endpoints(readers) + _endpoints(writers)

    def close(self) -> None:
        """Leave the graph."""
        self.node.destroy_node()
        self._context.try_shutdown()


def _never_called(message: object) -> None:
    """Stands where rclpy wants a callback; the queue is drained instead."""


def _endpoints(infos: list[Any]) -> list[Endpoint]:
    return [
        Endpoint(
            info.topic_type,
            bytes(info.endpoint_gid)[:16],
            f"{info.node_namespace.rstrip('/')}/{info.node_name}" if info.node_name != "_NODE_NAME_UNKNOWN_" else "",
            info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            and info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
        )
        for info in infos
    ]
