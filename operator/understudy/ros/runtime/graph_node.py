"""This process's place in the ROS graph: one node, which is never spun.

Subscriptions are drained (topic_watch.py), so no executor runs. The node offers no services, since nothing would answer
them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.interface_types import message_class
from understudy.ros.runtime.node_options import own_context, plain_node

if TYPE_CHECKING:
    from understudy.api.kinds.robot_workload import Output


class NotReceivable(RuntimeError):
    """A topic cannot be received as a type. The text says why.

    The cause is its name, or that this process already has the topic as another type.
    """


@dataclass(frozen=True)
class Endpoint:
    """A writer or reader that discovery has found."""

    type: str
    gid: bytes
    node: str
    """Fully qualified; empty until the node's own announcement has arrived."""
    latched: bool = False
    """Whether it is a writer that gives its last messages to late joiners (transient local)."""


class Crossing(Protocol):
    """A connection between a workload and its robot: a topic, service or action. Two of the three properties are None."""

    @property
    def topic(self) -> str | None:
        """Fully qualified name of the topic."""

    @property
    def service(self) -> str | None:
        """Name of the service, whichever side serves it."""

    @property
    def action(self) -> str | None:
        """Name of the action, whichever side serves it."""


class Graph:
    """One node and its view of the graph."""

    def __init__(self, name: str, *, domain_id: int | None = None) -> None:
        """Join the graph as node ``name``; the default of ``domain_id`` is ROS_DOMAIN_ID."""
        for variable, value in MIDDLEWARE.introspection.items():
            os.environ.setdefault(variable, value)
        self._context = own_context(domain_id=domain_id)
        self.node = plain_node(name, self._context)
        self.name = self.node.get_fully_qualified_name()

    @property
    def is_alone(self) -> bool:
        """Whether discovery has reported no other node, not even one whose name it has not learned yet."""
        return len(self.node.get_node_names_and_namespaces()) <= 1

    def subscribe(
        self, topic: str, type_name: str, *, depth: int, latched: bool = False, reliable: bool = False
    ) -> Any:
        """Create a subscription that matches every publisher: best effort, volatile, the last ``depth`` samples kept.

        With ``latched`` it matches publishers that are reliable and transient local, and receives their earlier
        messages. With ``reliable`` it matches reliable publishers, and misses none of their messages. Raises
        TypeNotInstalled and NotReceivable.
        """
        try:
            message = message_class(type_name)
        except ValueError as error:  # a publisher that uses DDS directly may have any type name
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
        except RuntimeError as error:  # from rclpy: a process can have a topic as one type only
            raise NotReceivable(
                f"{topic} cannot be received as {type_name}: everything that uses the topic in this process must use one type ({error})"
            ) from error

    def unsubscribe(self, subscription: Any) -> None:
        """Remove a subscription."""
        self.node.destroy_subscription(subscription)

    def publishers(self, topic: str) -> list[Endpoint]:
        """Return the publishers of a topic."""
        return _endpoints(self.node.get_publishers_info_by_topic(topic))

    def offers(self, topic: str) -> list[tuple[Endpoint, QoSProfile]]:
        """Return the publishers of a topic, each with the QoS that it offers."""
        infos = self.node.get_publishers_info_by_topic(topic)
        return list(zip(_endpoints(infos), (info.qos_profile for info in infos), strict=True))

    def requests(self, topic: str) -> list[tuple[Endpoint, QoSProfile]]:
        """Return the subscribers of a topic, this process's own too, each with the QoS that it requests."""
        infos = self.node.get_subscriptions_info_by_topic(topic)
        return list(zip(_endpoints(infos), (info.qos_profile for info in infos), strict=True))

    def publisher_count(self, topic: str) -> int:
        """Return the number of a topic's publishers, for a hundredth of the cost of listing them."""
        return int(self.node.count_publishers(topic))

    def topic_counts(self, topic: str) -> tuple[int, int]:
        """Return the numbers of a topic's publishers and subscribers, this process's own too."""
        return int(self.node.count_publishers(topic)), int(self.node.count_subscribers(topic))

    def service_counts(self, service: str) -> tuple[int, int]:
        """Return the numbers of a service's clients and servers, this process's own too."""
        return int(self.node.count_clients(service)), int(self.node.count_services(service))

    def endpoints_of(self, node: str) -> list[Endpoint]:
        """Return publishers or subscribers of all nodes with this full name.

        These are the endpoints on the first of the node's topics for which the graph lists any; empty if there is none.
        """
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
        endpoints = ([end for end in ends(topic) if end.node == node] for topic, ends in topics)
        return next((found for found in endpoints if found), [])

    def subscribers(self, topic: str) -> list[Endpoint]:
        """Return the subscribers of a topic, including this process's own."""
        return _endpoints(self.node.get_subscriptions_info_by_topic(topic))

    def type_of(self, topic: str) -> str | None:
        """Return the type that a topic's publishers announce; None if there are none, or they disagree."""
        types = {endpoint.type for endpoint in self.publishers(topic)}
        return types.pop() if len(types) == 1 else None

    def servers(self, service: str) -> list[Endpoint]:
        """Return the readers of a service's requests."""
        return _endpoints(self.node.get_subscriptions_info_by_topic(f"rq{service}Request", no_mangle=True))

    def requesters(self, service: str) -> list[Endpoint]:
        """Return the writers of a service's requests."""
        return _endpoints(self.node.get_publishers_info_by_topic(f"rq{service}Request", no_mangle=True))

    def clients(self, output: Output) -> list[Endpoint]:
        """Return the writers of an output's requests, goals and cancellations. Empty for a topic.

        They show who could call, and not who does. Receiving the requests would show that, but a further reader of them
        disturbs the service. rmw_fastrtps compares the number of readers of requests with that of writers of replies,
        so no client would find the service ready, except for a moment in which the server does not receive yet.
        """
        found = (self.node.get_publishers_info_by_topic(name, no_mangle=True) for name in MIDDLEWARE.requests(output))
        return [end for infos in found for end in _endpoints(infos)]

    def servers_of(self, output: Output) -> list[Endpoint]:
        """Return the readers of an output's requests, goals and cancellations. Empty for a topic."""
        found = (
            self.node.get_subscriptions_info_by_topic(name, no_mangle=True) for name in MIDDLEWARE.requests(output)
        )
        return [end for infos in found for end in _endpoints(infos)]

    def endpoints(self, output: Crossing) -> list[Endpoint]:
        """Return the endpoints for an output that workloads (and robots, for services and actions) have opened.

        These are publishers of a topic; servers and clients of a service; and those of an action's send_goal service.
        Their GIDs identify the pod.
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
    """Satisfy rclpy, which requires a callback; the queue is drained instead."""


def node_name(info: Any) -> str:
    """Return the full name of an endpoint's node; empty until the node's own announcement has arrived."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}" if info.node_name != "_NODE_NAME_UNKNOWN_" else ""


def _endpoints(infos: list[Any]) -> list[Endpoint]:
    return [
        Endpoint(
            info.topic_type,
            bytes(info.endpoint_gid)[:16],
            node_name(info),
            info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            and info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
        )
        for info in infos
    ]
