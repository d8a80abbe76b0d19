"""Forwards the requests of one service from the instances to the robot's own server, and the replies back to whoever asked.

The server of this process is in the partitions of all instances, and its client in none, by the profiles of the process
(ros/dds/profiles.py). A request that is not forwarded stays without a reply, as if the robot were not there.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from typing import Any

from rclpy.qos import qos_profile_services_default

from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Endpoint, Graph
from understudy.ros.runtime.service_exchange import RequestId, ServiceExchange, ServiceExchangeError, request_writer

_logger = logging.getLogger(__name__)

HELD = 2.0
"""Seconds for which a request is held until discovery has reported whose client sent it. It may have begun a moment ago, and would wait for
a reply in vain."""

PENDING = 1000
"""Requests that wait for the robot's reply. If there are more, the oldest is forgotten."""


class ForwardedService:
    """The server and the client of one service. For use in one thread."""

    def __init__(
        self, graph: Graph, service: str, type_: Any, output: str, exchange: ServiceExchange, wakeups: ArrivalWakeups
    ) -> None:
        """Begin to look for the robot's server. ``output`` is the service or action that this service belongs to."""
        self.output = output
        self._graph, self._service, self._type = graph, service, type_
        self._exchange, self._wakeups = exchange, wakeups
        self._client: Any = graph.node.create_client(type_, service, qos_profile=qos_profile_services_default)
        wakeups.add_client(self._client.handle)
        self._server: Any = None
        self._pending: OrderedDict[int, RequestId] = OrderedDict()
        self._held: list[tuple[Any, RequestId, float]] = []
        """Requests of unknown clients, each with the time at which it arrived."""
        self._senders: dict[str, bytes] = {}
        """The writer of each client, by the GUID that its requests have."""

    def counts(self) -> tuple[int, int]:
        """Return the numbers of its clients and servers, for a hundredth of the cost of listing them."""
        return self._graph.service_counts(self._service)

    def writers(self) -> list[Endpoint]:
        """Return the writers of requests besides this one."""
        return [end for end in self._graph.requesters(self._service) if end.node != self._graph.name]

    def follow(self, instances: Collection[bytes]) -> None:
        """Serve as long as the robot does, so that an instance that waits for the service waits for the robot's."""
        is_there = bool(self._client.service_is_ready())
        if is_there and self._server is None:
            self._server = self._graph.node.create_service(
                self._type, self._service, _never_called, qos_profile=qos_profile_services_default
            )
            self._wakeups.add_service(self._server.handle)
        elif not is_there and self._server is not None:
            self._graph.node.destroy_service(self._server)
            self._server = None
            self._pending.clear()
        self._senders = {client: writer for client, writer in self._senders.items() if writer in instances}

    def drain(self, forwards: Callable[[bytes], bool | None]) -> int:
        """Forward the requests that have arrived, if a function accepts the GID of their writer, and all replies.

        The function returns None for a writer that it does not know yet. Returns the number of requests. Raises ServiceExchangeError.
        """
        if self._server is None:
            return 0
        now, forwarded = time.monotonic(), 0
        arrived, self._held = self._held, []
        while (taken := self._exchange.take(self._server, self._type.Request)) is not None:
            arrived.append((*taken, now))
        for request, identity, since in arrived:
            writer = self._writer(identity)
            accepted = forwards(writer) if writer is not None else None
            if accepted:
                self._send(request, identity)
                forwarded += 1
            elif accepted is None and now - since < HELD:
                self._held.append((request, identity, since))
        self._reply()
        return forwarded

    def forget(self) -> None:
        """Drop what is held: another instance is in control from now on."""
        self._held.clear()

    def command(self, values: Mapping[str, Any]) -> None:
        """Nothing: a safe command is a message."""

    def _writer(self, identity: RequestId) -> bytes | None:
        if identity.client not in self._senders:
            found = request_writer(identity, [end.gid for end in self.writers()])
            if found is None:
                return None
            self._senders[identity.client] = found
        return self._senders[identity.client]

    def _send(self, request: Any, identity: RequestId) -> None:
        with self._client.handle:
            number: int = self._client.handle.send_request(request)
        self._pending[number] = identity
        if len(self._pending) > PENDING:
            self._pending.popitem(last=False)

    def _reply(self) -> None:
        while True:
            with self._client.handle:
                info, response = self._client.handle.take_response(self._type.Response)
            if info is None:
                return
            identity = self._pending.pop(info.request_id.sequence_number, None)
            if identity is None:
                continue
            try:
                self._exchange.answer(self._server, response, identity)
            except ServiceExchangeError as error:
                _logger.warning("a reply of the robot is lost: %s", error)


def _never_called(request: object, response: Any) -> Any:
    """Satisfy rclpy, which requires a callback; requests are drained instead."""
    return response
