"""Streams of snapshots of a tree, as py_trees_ros offers them (its SnapshotStream), for its watcher and its viewers.

``NAMESPACE/snapshots`` always exists. A tool without a topic finds ``NAMESPACE/snapshot_streams/open`` by its type
instead, and gets a stream of its own with a period of its own, until the tool closes it.

Nothing here blocks except the answers, which a thread sends: the middleware may take a tenth of a second for a client
that has only just appeared.
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_services_default

from understudy.ros.runtime.graph_node import Graph
from understudy.ros.runtime.interface_types import interface_class
from understudy.ros.runtime.service_exchange import RequestId, ServiceExchange, ServiceExchangeError
from understudy.trees.core.snapshot_behaviours import Behaviour, statuses

_logger = logging.getLogger(__name__)

PACKAGE = "py_trees_ros_interfaces"

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The QoS that the readers request: a reader that joins late receives the last snapshot."""

LEAST = 0.2
"""Minimum seconds between two snapshots of a stream."""

WORDS = 1.0
"""Seconds between two snapshots if only messages have changed, such as the figure of a rate that fails."""

MOST = 16
"""Largest number of streams. A tool that opens more gets the one that always exists."""

ABANDONED = 60.0
"""Seconds without a reader after which an opened stream is closed, because its tool has ended."""

PATIENCE = 5.0
"""Seconds for which an answer is tried again."""

_NOT_A_BLACKBOX = 4  # py_trees_ros_interfaces/msg/Behaviour: no level is hidden
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")


@dataclass
class _Stream:
    """One topic, and the last snapshot on it."""

    publisher: Any
    period: float
    """Maximum seconds between snapshots without a change; infinite for no maximum."""
    read: float
    """When it last had a reader, or was opened, in monotonic seconds."""
    readers: int = 0
    fresh: bool = True
    """Whether a reader has joined since the last snapshot."""
    shown: float = -math.inf
    statuses: tuple[object, ...] = ()
    listed: Sequence[Behaviour] = ()
    count: int = 0


@dataclass
class _Unanswered:
    """An answer that was not delivered yet."""

    service: Any
    response: Any
    request: RequestId
    until: float


class Streams:
    """The streams of one tree. For use in one event loop."""

    def __init__(self, graph: Graph, namespace: str) -> None:
        """Offer the streams below a namespace such as ``/understudy/robot_1``. Raises TypeNotInstalled."""
        self._graph, self._namespace = graph, namespace
        self._types = {name: interface_class(f"{PACKAGE}/msg/{name}") for name in ("BehaviourTree", "Behaviour")}
        self._types["UUID"] = interface_class("unique_identifier_msgs/msg/UUID")
        services = {name: interface_class(f"{PACKAGE}/srv/{name.title()}SnapshotStream") for name in _SERVICES}
        self._exchange = ServiceExchange()
        self._streams: dict[str, _Stream] = {}
        self._opened = 0
        self._unanswered: list[_Unanswered] = []
        self.default = f"{namespace}/snapshots"
        """The topic of the stream that always exists."""
        self._add(self.default, math.inf)
        self._services = [
            (
                graph.node.create_service(
                    type_,
                    f"{namespace}/snapshot_streams/{name}",
                    _never_called,
                    qos_profile=qos_profile_services_default,
                ),
                type_,
                getattr(self, f"_{name}"),
            )
            for name, type_ in services.items()
        ]

    @property
    def periods(self) -> dict[str, float]:
        """The maximum seconds between snapshots without a change, by the topic of each stream."""
        return {name: stream.period for name, stream in self._streams.items()}

    # -- snapshots --------------------------------------------------------------------------------------------------

    def read(self) -> bool:
        """Return whether any stream has a reader now. Call it at intervals, before a snapshot is made."""
        now = time.monotonic()
        for name, stream in list(self._streams.items()):
            readers = int(stream.publisher.get_subscription_count())
            stream.fresh = stream.fresh or readers > stream.readers
            stream.readers = readers
            if readers:
                stream.read = now
            elif name != self.default and now > stream.read + ABANDONED:
                self._remove(name)
        return any(stream.readers for stream in self._streams.values())

    def show(self, listed: Sequence[Behaviour]) -> int:
        """Publish the state of the tree on each stream that has readers and is due.

        Returns the number of these streams.
        """
        now, found = time.monotonic(), statuses(listed)
        message = None
        published = 0
        for stream in self._streams.values():
            changed = found != stream.statuses
            if not stream.readers or not self._due(stream, listed, now, changed=changed):
                continue
            if message is None:
                message = self._message(listed)
            stream.count += 1
            message.changed = changed
            message.statistics.count = stream.count
            message.statistics.tick_interval = now - stream.shown if stream.count > 1 else 0.0
            stream.publisher.publish(message)
            stream.fresh, stream.shown, stream.statuses, stream.listed = False, now, found, listed
            published += 1
        return published

    @staticmethod
    def _due(stream: _Stream, listed: Sequence[Behaviour], now: float, *, changed: bool) -> bool:
        since = now - stream.shown
        if since < LEAST:
            return False
        return stream.fresh or changed or since >= stream.period or (since >= WORDS and listed != stream.listed)

    def _message(self, listed: Sequence[Behaviour]) -> Any:
        uuid = self._types["UUID"]
        message = self._types["BehaviourTree"]()
        now = time.time_ns()
        message.statistics.stamp.sec, message.statistics.stamp.nanosec = divmod(now, 1_000_000_000)
        message.behaviours = [
            self._types["Behaviour"](
                name=node.name,
                class_name=f"understudy.{node.kind}",
                own_id=uuid(uuid=list(node.id)),
                parent_id=uuid(uuid=list(node.parent)),
                tip_id=uuid(uuid=list(node.tip)),
                child_ids=[uuid(uuid=list(child)) for child in node.children],
                current_child_id=uuid(uuid=list(node.current)),
                type=node.type,
                additional_detail=node.detail,
                blackbox_level=_NOT_A_BLACKBOX,
                status=node.status,
                message=node.message,
                is_active=node.active,
            )
            for node in listed
        ]
        return message

    # -- services ---------------------------------------------------------------------------------------------------

    async def serve(self) -> None:
        """Take the requests that have arrived, and answer them."""
        for service, type_, handle in self._services:
            while (found := self._exchange.take(service, type_.Request)) is not None:
                request, identity = found
                response = type_.Response()
                handle(request, response)
                self._unanswered.append(_Unanswered(service, response, identity, time.monotonic() + PATIENCE))
        waiting, self._unanswered = self._unanswered, []
        for answer in waiting:
            try:
                done = await asyncio.to_thread(self._exchange.answer, answer.service, answer.response, answer.request)
            except ServiceExchangeError as error:
                _logger.error("%s: %s", self._namespace, error)
                continue
            if not done and time.monotonic() < answer.until:
                self._unanswered.append(answer)

    def _open(self, request: Any, response: Any) -> None:
        period = _period(request.parameters.snapshot_period)
        name = f"{self._namespace}/snapshot_streams/{self._hint(request.topic_name)}"
        if name in self._streams:
            self._streams[name].period = period
        elif len(self._streams) < MOST:
            self._add(name, period)
        else:
            name = self.default
        response.topic_name = name

    def _close(self, request: Any, response: Any) -> None:
        response.result = request.topic_name in self._streams and request.topic_name != self.default
        if response.result:
            self._remove(request.topic_name)

    def _reconfigure(self, request: Any, response: Any) -> None:
        stream = self._streams.get(request.topic_name)
        response.result = stream is not None and request.topic_name != self.default
        if stream is not None and response.result:
            stream.period = _period(request.parameters.snapshot_period)

    def _hint(self, wanted: str) -> str:
        """Return the last part of a stream's topic, from the name that a tool wants.

        A full name is ignored, because tools do not decide where in the graph this process publishes.
        """
        if _NAME.fullmatch(wanted):
            return wanted
        self._opened += 1
        return f"_snapshots_{self._opened - 1}"

    def _add(self, name: str, period: float) -> None:
        publisher = self._graph.node.create_publisher(self._types["BehaviourTree"], name, LATCHED)
        self._streams[name] = _Stream(publisher, period, time.monotonic())

    def _remove(self, name: str) -> None:
        self._graph.node.destroy_publisher(self._streams.pop(name).publisher)

    def close(self) -> None:
        """Remove all topics and services."""
        for name in list(self._streams):
            self._remove(name)
        for service, _, _ in self._services:
            self._graph.node.destroy_service(service)
        self._services = []


_SERVICES = ("open", "close", "reconfigure")


def _period(wanted: float) -> float:
    """Return the period that a tool requested, in seconds.

    An infinite period, or a value that is not a number, means snapshots only on changes.
    """
    return math.inf if math.isnan(wanted) else max(LEAST, wanted)


def _never_called(request: object, response: object) -> object:
    """Satisfy rclpy, which requires a callback; the queue is drained instead."""
    return response
