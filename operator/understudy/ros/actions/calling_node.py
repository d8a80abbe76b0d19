"""The node with which an agent calls services of its instance, and its view of the graph.

If the host is known, only endpoints on this host count as the instance's. Behind a discovery server an agent also
discovers the other instances' servers, which network policies keep it from reaching. With a mux, DDS partitions do that, so that it does
not match their endpoints either.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.interface_types import interface_class

if TYPE_CHECKING:
    from understudy.ros.runtime.service_client import ServiceClient

MOST_CLIENTS = 64
"""Service clients kept for further calls; a new one costs a round of discovery."""

ANNOUNCEMENTS = "ros_discovery_info"
"""The topic on which each ROS participant announces which node has which endpoint; other participants have no nodes."""

QUEUE = 100
"""Samples that may wait in a queue between two reads."""


@dataclass(frozen=True)
class GraphLocation:
    """The place in ROS that this process has already joined."""

    context: Any
    """The rclpy context of its graph. Another context would be another participant, which would have to be discovered
    again."""
    host: bytes | None = None
    """The host part of the GIDs of this host's endpoints (Middleware.host_of); None if the endpoints of all hosts
    count."""


class CallingNode:
    """A node at a location, with the clients that it keeps for further calls."""

    def __init__(self, name: str, location: GraphLocation | None) -> None:
        from understudy.ros.runtime.served_node import ServedNode

        self.host = location.host if location is not None else None
        self._context = location.context if location is not None else None
        self._served = ServedNode(name, context=self._context)
        self.node = self._served.node
        self._clients: dict[tuple[str, str], ServiceClient] = {}
        self._is_kept_apart = MIDDLEWARE.is_kept_apart(os.environ)

    def is_at(self, location: GraphLocation | None) -> bool:
        """Return whether the node was created at this location and is still alive."""
        if not self._served.alive:
            return False
        if location is None:
            return self._context is None
        return location.context is self._context and location.host == self.host

    def close(self) -> None:
        """Leave the graph."""
        self._served.shut_down()

    # -- presence ----------------------------------------------------------------------------------------------------

    def serves(self, service: str) -> bool:
        """Whether a service has a server here, with its reader of requests and its writer of answers."""
        readers = self.node.get_subscriptions_info_by_topic(f"rq{service}Request", no_mangle=True)
        if not any(self._here(reader) for reader in readers):
            return False
        return any(map(self._here, self.node.get_publishers_info_by_topic(f"rr{service}Reply", no_mangle=True)))

    def has_node(self, name: str) -> bool:
        """Whether a node is here. On one known host its parameter events identify it, which nearly every node has."""
        if self.host is None:
            known = self.node.get_node_names_and_namespaces()
            return any(f"{namespace.rstrip('/')}/{node}" == name for node, namespace in known)
        writers = self.node.get_publishers_info_by_topic("/parameter_events")
        return any(self._here(w) and f"{w.node_namespace.rstrip('/')}/{w.node_name}" == name for w in writers)

    def is_read(self, publisher: Any, topic: str, type_name: str) -> bool:
        """Whether all readers of a topic of that type are matched that can be, and one of them is here."""
        readers = [e for e in self.node.get_subscriptions_info_by_topic(topic) if e.topic_type == type_name]
        here = sum(map(self._here, readers))
        reached = here if self._is_kept_apart else len(readers)
        return here > 0 and bool(publisher.get_subscription_count() >= reached)

    def is_read_elsewhere(self, publisher: Any, topic: str, type_name: str) -> bool:
        """Whether a reader on another host subscribes to a topic and is matched by a publisher of this process.

        Of a pod that is kept apart, that is the monitor, or a former one whose process or node has ended.
        """
        readers = [e for e in self.node.get_subscriptions_info_by_topic(topic) if e.topic_type == type_name]
        here = sum(map(self._here, readers))
        return here < (publisher.get_subscription_count() if self._is_kept_apart else len(readers))

    def subscribers(self, topic: str, type_name: str) -> set[str]:
        """Return the full names of the ROS nodes here that subscribe to a topic; empty for one that is not known yet."""
        from understudy.ros.runtime.graph_node import node_name

        announcements = self.node.get_publishers_info_by_topic(ANNOUNCEMENTS, no_mangle=True)
        participants = {MIDDLEWARE.process_of(bytes(writer.endpoint_gid)) for writer in announcements}
        readers = self.node.get_subscriptions_info_by_topic(topic)
        here = [e for e in readers if e.topic_type == type_name and self._here(e)]
        return {node_name(e) for e in here if MIDDLEWARE.process_of(bytes(e.endpoint_gid)) in participants}

    def published_types(self, topic: str) -> set[str]:
        """Return the types of a topic's publishers that are here."""
        return {e.topic_type for e in self.node.get_publishers_info_by_topic(topic) if self._here(e)}

    def _here(self, endpoint: Any) -> bool:
        return self.host is None or MIDDLEWARE.host_of(bytes(endpoint.endpoint_gid)) == self.host

    # -- entities ---------------------------------------------------------------------------------------------------

    async def client(self, service: str, type_name: str) -> ServiceClient:
        """Return a client of a service. Raises TypeNotInstalled, ValueError."""
        if "/srv/" not in type_name:
            raise ValueError(
                f"{type_name!r} is not a service type: write package/srv/Name, such as std_srvs/srv/Trigger"
            )
        found = self._clients.pop((service, type_name), None)
        if found is None:
            type_ = interface_class(type_name)
            from understudy.ros.runtime.service_client import ServiceClient

            found = await self._served.get(lambda: ServiceClient(self._served, type_, service))
            if (other := self._clients.pop((service, type_name), None)) is not None:  # another call was faster
                await self._served.get(found.close)
                found = other
        self._clients[service, type_name] = found
        while len(self._clients) > MOST_CLIENTS:
            oldest = self._clients.pop(next(iter(self._clients)))
            await self._served.get(oldest.close)
        return found

    def publisher(self, cls: Any, topic: str, count: int) -> Any:
        """Create a publisher that every subscriber matches, whatever QoS the subscriber requests."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        qos = QoSProfile(
            depth=max(1, count),
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        return self.node.create_publisher(cls, topic, qos)

    def subscription(self, cls: Any, topic: str, *, latched: bool) -> Any:
        """Create a subscription that is drained: to every writer, or to those that keep messages for late readers."""
        from rclpy.event_handler import SubscriptionEventCallbacks
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        qos = QoSProfile(
            depth=QUEUE,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return self.node.create_subscription(
            cls,
            topic,
            _never_called,
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )


def _never_called(message: object) -> None:
    """Satisfy rclpy, which requires a callback; the queue is drained instead."""
