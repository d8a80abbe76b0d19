"""The last messages of topics whose state is kept, as serialized bytes, of the active instance or the robot.

The topics are drained like watched ones (topic_watch.py), and messages are never deserialized. If a publisher gives its
last message to late joiners, that message is requested too, so that a pose published once before the monitor started is
known. Such a message is distinguished from a fresh one by its time, and remains valid until the next one arrives.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from understudy.ros.observe.sample_sources import Sources
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.graph_node import Graph, NotReceivable
from understudy.ros.runtime.interface_types import TypeNotInstalled
from understudy.ros.runtime.sample_taking import SampleTaker

_logger = logging.getLogger(__name__)

DEPTH = 4
"""Messages that a topic's queue holds between two drains. Only the last is of interest, but another instance may
publish on the same topic. The middleware drops further messages, since taking them costs time."""

PUBLISHER_CHECK_PERIOD = 1.0
"""Seconds between checks of the graph for a topic that nobody publishes yet, and of the number of its publishers."""

RECHECK_PERIOD = 10.0
"""Seconds between checks of whether publishers have changed although their number has not."""

LARGEST_WAITING = 1024 * 1024
"""Largest message of a standby, in bytes, that is remembered for when it takes over. A larger one is a map, which is
the same for all."""


class Captured(NamedTuple):
    """A message of a kept topic. Times are Unix seconds by this machine's clock."""

    topic: str
    type: str
    data: bytes
    """CDR with its 4-byte header."""
    taken_at: float
    """When it was received, or when it was written if that was before the subscription."""
    received_at: float
    standing: Literal["", "instance", "robot"]
    """Which side's publisher gives it to late joiners; empty if none does. Such a message is valid until the next one.
    """
    writer: bytes = b""
    """GID of its publisher."""


@dataclass
class _Topic:
    """A topic and its subscription."""

    name: str
    type: str | None
    subscription: Any = None
    subscribed_type: str = ""
    subscribed_at: float = 0.0
    latched: bool = False
    matched: int = 0
    next_count: float = 0.0
    next_check: float = 0.0
    problem: str = ""
    waiting: str = ""
    latest: dict[bytes, Captured] = field(default_factory=dict)
    """The last message of each instance, by the HOST part of its GIDs, if its publisher gives it to late joiners."""


class StateSamples:
    """Captures the topics of a policy's ``state``. For the thread that drains."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._taker = SampleTaker()
        self._topics: dict[str, _Topic] = {}
        self._sources = Sources({})
        self._active = ""
        self._again: list[Captured] = []

    def follow(self, topics: Mapping[str, str | None]) -> None:
        """Capture these topics, each with its type if that is known, and no others. Cheap if nothing changed."""
        for name in [name for name, topic in self._topics.items() if topics.get(name, "") != topic.type]:
            self._end(self._topics.pop(name))
        for name, type_name in topics.items():
            if name not in self._topics:
                self._topics[name] = topic = _Topic(name, type_name)
                self._subscribe(topic)

    def attribute(self, instances: Mapping[str, str], active: str) -> bool:
        """Set the instances (IP by pod name) and the active one (empty for none).

        Returns whether another instance is active than before. Cheap if nothing changed.
        """
        if active == self._active and instances == self._sources.instances:
            return False
        changed, self._active = active != self._active, active
        self._sources = Sources(instances)
        for topic in self._topics.values():
            topic.latest = {host: last for host, last in topic.latest.items() if self._sources.candidates(host)}
            if changed:
                # Messages that it published as a standby remain valid, and are not published again.
                self._again += [last for host, last in topic.latest.items() if self._counts(host)]
        return changed

    @property
    def problems(self) -> dict[str, str]:
        """Why a topic cannot be kept and how to correct that, as text for users, by topic."""
        return {name: topic.problem for name, topic in self._topics.items() if topic.problem}

    @property
    def waiting(self) -> dict[str, str]:
        """Why a topic cannot be kept yet, by topic."""
        return {name: topic.waiting for name, topic in self._topics.items() if topic.waiting}

    def _counts(self, host: bytes) -> bool:
        """Whether a host's messages are state: the host is no instance, or it is certainly the active one."""
        candidates = self._sources.candidates(host)
        return not candidates or candidates == (self._active,)

    # -- subscriptions ----------------------------------------------------------------------------------------------

    def _subscribe(self, topic: _Topic) -> None:
        """Subscribe in the way that the present publishers require."""
        publishers = self._graph.publishers(topic.name)
        topic.next_check = time.monotonic() + (RECHECK_PERIOD if publishers else PUBLISHER_CHECK_PERIOD)
        topic.problem = topic.waiting = ""
        types = {publisher.type for publisher in publishers}
        type_name = topic.type or (types.pop() if len(types) == 1 else None)
        if type_name is None:
            if types:
                names = ", ".join(sorted(types))
                topic.problem = f"its publishers disagree about its type ({names}): give the type in state.keep"
            else:
                topic.waiting = "nobody publishes it, so its type is not known"
            return
        if topic.type is not None and types and topic.type not in types:
            topic.problem = f"it is published as {', '.join(sorted(types))}, not as {topic.type}: correct state.keep"
        elif not types:
            topic.waiting = "nobody publishes it"
        latched = all(publisher.latched for publisher in publishers) if publishers else topic.latched
        if topic.subscription is not None and (topic.latched, topic.subscribed_type) == (latched, type_name):
            return
        self._end(topic)
        try:
            topic.subscription = self._graph.subscribe(topic.name, type_name, depth=DEPTH, latched=latched)
        except (TypeNotInstalled, NotReceivable) as error:
            topic.problem = str(error)
            return
        topic.latched, topic.subscribed_type, topic.subscribed_at = latched, type_name, time.time()

    def _end(self, topic: _Topic) -> None:
        if topic.subscription is not None:
            self._graph.unsubscribe(topic.subscription)
            topic.subscription = None

    def close(self) -> None:
        """Remove all subscriptions. The graph belongs to the caller."""
        for topic in self._topics.values():
            self._end(topic)
        self._topics.clear()

    # -- receiving --------------------------------------------------------------------------------------------------

    def drain(self) -> list[Captured]:
        """Return the last message of each topic that has arrived since the last call, if there is one."""
        found, self._again = self._again, []
        now = time.monotonic()
        for topic in self._topics.values():
            if topic.subscription is not None:
                found += self._drain(topic)
            if now >= topic.next_count:
                topic.next_count = now + PUBLISHER_CHECK_PERIOD
                matched = topic.subscription.get_publisher_count() if topic.subscription is not None else 0
                if matched != topic.matched or now >= topic.next_check:
                    topic.matched = matched
                    self._subscribe(topic)
        return found

    def _drain(self, topic: _Topic) -> list[Captured]:
        last: Captured | None = None
        with topic.subscription.handle:
            pointer = topic.subscription.handle.pointer
            # Limited, because a writer may be faster than this process.
            for _ in range(2 * DEPTH):
                sample = self._taker.take(pointer, with_data=False)
                if sample is None:
                    break
                received, sent, gid, _, _ = sample
                host = MIDDLEWARE.host_of(gid)
                counts = self._counts(host)
                if not counts and not topic.latched:
                    continue
                late = topic.latched and sent < topic.subscribed_at
                message = Captured(
                    topic.name,
                    topic.subscribed_type,
                    self._taker.data(),
                    min(received, sent) if late else received,
                    received,
                    "" if not topic.latched else "instance" if self._sources.candidates(host) else "robot",
                    gid,
                )
                if topic.latched and self._sources.candidates(host) and len(message.data) <= LARGEST_WAITING:
                    topic.latest[host] = message
                if counts and (last is None or _order(message) >= _order(last)):
                    last = message
        return [last] if last is not None else []

    def shift(self, step: float) -> None:
        """Move all times by ``step`` seconds, after the clock was set."""
        for topic in self._topics.values():
            topic.subscribed_at += step
            topic.latest = {
                host: last._replace(taken_at=last.taken_at + step, received_at=last.received_at + step)
                for host, last in topic.latest.items()
            }


def _order(message: Captured) -> float:
    """Return a sort key that is largest for the last message. Of two latched messages, the one that was written later
    is last."""
    return message.taken_at if message.standing else math.inf
