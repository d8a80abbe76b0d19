"""Watches topics by draining their queues, without a callback for each message.

Fast DDS stores arriving messages in a subscription's history and stamps them with the time of receipt. So times are
exact although the queues are read only at intervals, and reading costs a few microseconds per message instead of an
executor's round. The process's own loop calls :meth:`TopicWatch.drain`; no rclpy executor runs.
"""

from __future__ import annotations

import logging
import math
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from understudy.clock import ClockSteps
from understudy.ros.observe.graph_presence import NodePresenceWatch, PublisherPresence
from understudy.ros.observe.lifecycle_states import LifecycleStates
from understudy.ros.observe.message_contents import HEAD, OURS, Received, begins_with_header, ours
from understudy.ros.observe.parameter_values import ParameterValues
from understudy.ros.observe.sample_rings import SampleRing, SampleTrack
from understudy.ros.observe.sample_sources import Sources, named
from understudy.ros.rmw import MIDDLEWARE
from understudy.ros.runtime.arrival_wakeups import ArrivalWakeups
from understudy.ros.runtime.graph_node import Graph, NotReceivable
from understudy.ros.runtime.interface_types import TypeNotInstalled, message_class
from understudy.ros.runtime.sample_taking import SampleTaker
from understudy.trees.core import task_activity
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import (
    NodePresence,
    NodeState,
    ParameterState,
    PodState,
    Publishers,
    TopicRecord,
)
from understudy.trees.leaves import diagnostics
from understudy.trees.leaves.lifecycle import EVENTS

_logger = logging.getLogger(__name__)

STALL = 0.25
"""Maximum seconds between two drains that a queue must bridge: several ticks, since a busy node may delay this
process."""

LONG_STALL = 1.0
"""Seconds between two drains after which samples count as lost, or as stamped late, even if their sequence numbers have no gap."""

CATCH_UP = 0.25
"""Seconds after a stall for which samples of the stall may still arrive: from the socket's buffer, and from writers that
send again."""

USUAL_RATE = 50.0
"""Messages per second for which a queue is sized if the tree does not give a rate."""

LEAST_DEPTH, MOST_DEPTH = 10, 1000

HISTORY = 10.0
"""Seconds of arrivals that are kept per source, for questions about the time since a switch."""

FORGET = 600.0
"""Seconds of silence after which a host may be forgotten: over months, many addresses of pods come and go."""

TYPE_CHECK_PERIOD = 1.0
"""Seconds between attempts to read the type of a topic from the graph."""

MOST_WRITERS = 64
"""Writers of one host that are distinguished. A host that restarts its nodes for months has had many."""


def depth(topic: WatchedTopic) -> int:
    """Return how many samples a topic's queue must hold."""
    rate = topic.rate if topic.rate is not None else USUAL_RATE
    return min(MOST_DEPTH, max(LEAST_DEPTH, math.ceil(rate * STALL)))


class SourceRecord(TopicRecord):
    """The samples received on one topic from one host."""

    __slots__ = ("accepted", "lost", "newest_writer", "sequences")

    def __init__(self, window: float, contents: int = 0) -> None:
        super().__init__(window, contents)
        self.accepted = True
        """Whether it counts for the active instance."""
        self.lost = 0
        """Number of messages that were sent after the first received one and never arrived, by their sequence
        numbers."""
        self.sequences: dict[bytes, int] = {}
        """The last sequence number of each of the host's writers, by GID."""
        self.newest_writer = 0.0
        """When the first sample of the writer that is newest here was received."""

    def shift(self, seconds: float) -> None:
        """Move all times by ``seconds``."""
        super().shift(seconds)
        self.newest_writer += seconds

    def number(self, gid: bytes, sequence: int, received: float) -> bool:
        """Note a sample's sequence number. Returns whether numbers are missing before it."""
        before = self.sequences.get(gid)
        missing = before is not None and sequence > before + 1
        if before is None:
            self.newest_writer = received
            if len(self.sequences) >= MOST_WRITERS:
                self.sequences.clear()
        elif missing:
            self.lost += sequence - before - 1
        self.sequences[gid] = sequence
        return missing


@dataclass
class _Topic:
    """A watched topic and its samples."""

    want: WatchedTopic
    subscription: Any = None
    message: Any = None
    """The class of the messages that the subscription receives."""
    type: str = ""
    """Its type."""
    track: SampleTrack | None = None
    """Where its serialized messages are stored."""
    stamped: bool = False
    """Whether its messages begin with a header."""
    mixed: bool = False
    """Whether messages of Understudy itself, which are no evidence, may be among them."""
    problem: str = ""
    waiting: str = ""
    sources: dict[bytes, SourceRecord] = field(default_factory=dict)
    counted: TopicRecord = field(default_factory=TopicRecord)
    """Samples that count for the active instance."""
    active: dict[bytes, float] = field(default_factory=dict)
    """For the status topic of an action: when each server with an active goal got the goal, by the GID of its
    writer."""


class TopicWatch:
    """The topics of a health tree, as this process receives them, attributed to pods.

    It provides the Observations from all samples except those of instances of the workload that are not active: the
    samples of the robot's own topics, and of the active instance. All times are Unix seconds by this machine's clock.
    When the clock is set, they are moved with it, so that a step of the clock does not look like a gap.
    """

    def __init__(self, graph: Graph, own: bytes | None = None, arrivals: ArrivalWakeups | None = None) -> None:
        """``own`` is the HOST part of GIDs of the instance that is judged, if this process is in that instance.

        ``arrivals`` wakes the process for messages that must be evaluated on arrival.
        """
        self._graph = graph
        self._own = own
        self._presence = PublisherPresence(graph, self._in_control)
        self._inhabitants = NodePresenceWatch(graph, self._in_control)
        self._lifecycles = LifecycleStates(graph, self._in_control, self.own, alone=own is not None)
        self._parameters = ParameterValues(graph, self._in_control, self.own, alone=own is not None)
        self.pod_state: PodState | None = None
        """The cluster's state of the active instance's pod, if this process knows it."""
        self._taker = SampleTaker()
        self._arrivals = arrivals
        self._ring: SampleRing | None = None
        self._records_counted = False
        self._topics: dict[str, _Topic] = {}
        self._sources = Sources({})
        self._senders: dict[bytes, bytes] = {}
        """By the GID of a writer, the key of the pod that it belongs to, if that is known from more than its address."""
        self._active = ""
        self._next_look_up = 0.0
        self._steps = ClockSteps()
        self._drained = time.time()
        self._drained_at = time.monotonic()
        self._losing_until = self._observed_since = -math.inf

    # -- topics ------------------------------------------------------------------------------------------------------

    def follow(self, topics: Iterable[WatchedTopic]) -> None:
        """Watch these topics and no others. Cheap if nothing changed. Topics that are already watched keep their
        samples."""
        topics = list(topics)
        self._presence.follow([topic.name for topic in topics if topic.publishers])
        self._inhabitants.follow([topic.name for topic in topics if topic.node])
        self._lifecycles.follow([topic.name.removesuffix(EVENTS) for topic in topics if topic.managed])
        self._parameters.follow(parameter for topic in topics for parameter in topic.parameters)
        wanted = {topic.name: topic for topic in topics if topic.subscribed}
        for name in [name for name in self._topics if name not in wanted]:
            self._end(self._topics.pop(name))
        for name, want in wanted.items():
            known = self._topics.get(name)
            if known is None:
                self._topics[name] = known = _Topic(want, counted=TopicRecord(want.window, want.contents))
                self._subscribe(known)
            elif known.want != want:
                self._change(known, want)

    def record(self, ring: SampleRing | None, *, only_counted: bool = False) -> None:
        """Store the messages themselves in a ring from now on; with None, no longer.

        With ``only_counted``, only those that count as evidence: a process that also receives the instances that the robot does not.
        """
        self._ring, self._records_counted = ring, only_counted
        for topic in self._topics.values():
            self._record(topic)

    def _record(self, topic: _Topic) -> None:
        ring = self._ring if topic.subscription is not None else None
        topic.track = ring.track(topic.want.name, topic.type) if ring is not None else None

    @property
    def problems(self) -> list[str]:
        """Why topics are not watched and how to correct that, as text for users."""
        unwatched = [topic.problem for topic in self._topics.values() if topic.problem]
        return [*unwatched, *self._lifecycles.problems, *self._parameters.problems]

    @property
    def unwatchable(self) -> frozenset[str]:
        """The topics of those problems."""
        return frozenset(name for name, topic in self._topics.items() if topic.problem)

    @property
    def waiting(self) -> list[str]:
        """Topics that cannot be watched before somebody publishes them, as text for users."""
        return [topic.waiting for topic in self._topics.values() if topic.waiting]

    def _change(self, topic: _Topic, want: WatchedTopic) -> None:
        looks_into = (want.contents, want.whole) != (topic.want.contents, topic.want.whole)
        again = topic.subscription is None or want.type != topic.want.type or depth(want) > depth(topic.want)
        prompt_changed = want.prompt != topic.want.prompt
        again = again or want.reliable != topic.want.reliable
        topic.want = want
        for source in topic.sources.values():
            source.window = max(want.window, HISTORY)
            if looks_into:  # the earlier samples may lack what is needed now
                source.contents = deque(maxlen=want.contents)
        self._count_again(topic)
        if again:
            self._end(topic)
            self._subscribe(topic)
        elif prompt_changed:
            self._set_wakeup(topic)

    def _subscribe(self, topic: _Topic) -> None:
        want = topic.want
        topic.problem = topic.waiting = ""
        type_name = want.type or self._graph.type_of(want.name)
        if type_name is None:
            if found := {endpoint.type for endpoint in self._graph.publishers(want.name)}:
                types = ", ".join(sorted(found))
                topic.problem = (
                    f"the publishers of {want.name} disagree about its type ({types}): give the type in the tree"
                )
            else:
                topic.waiting = (
                    f"the type of {want.name} is not known, since nobody publishes it yet: "
                    f"correct its name, or give the type in the tree"
                )
            return
        try:
            subscription = self._graph.subscribe(
                want.name, type_name, depth=depth(want), latched=want.task, reliable=want.reliable
            )
        except TypeNotInstalled as error:
            topic.problem = f"{want.name}: {error}"
            return
        except NotReceivable as error:
            topic.problem = str(error)
            return
        topic.message, topic.type, topic.subscription = message_class(type_name), type_name, subscription
        topic.stamped = begins_with_header(topic.message)
        topic.mixed = type_name == diagnostics.TYPE
        self._record(topic)
        if want.prompt:
            self._set_wakeup(topic)

    def _set_wakeup(self, topic: _Topic) -> None:
        """Start or stop waking this process for messages of a topic on arrival."""
        if self._arrivals is None or topic.subscription is None:
            return
        switch = self._arrivals.add if topic.want.prompt else self._arrivals.forget
        switch(topic.subscription.handle)

    def _end(self, topic: _Topic) -> None:
        if topic.subscription is not None:
            if self._arrivals is not None:
                self._arrivals.forget(topic.subscription.handle)
            self._graph.unsubscribe(topic.subscription)
            topic.subscription = None
        topic.active.clear()

    def _find_types(self) -> None:
        """Try again to subscribe to topics whose type is known only from the graph."""
        for topic in self._topics.values():
            if topic.subscription is None and topic.want.type is None:
                self._subscribe(topic)

    def _forget_servers(self) -> None:
        """Forget the goals of servers that have gone: such a server can no longer report their end."""
        for topic in self._topics.values():
            if topic.active:
                there = {endpoint.gid for endpoint in self._graph.publishers(topic.want.name)}
                for gid in [gid for gid in topic.active if gid not in there]:
                    del topic.active[gid]

    # -- attribution -------------------------------------------------------------------------------------------------

    @property
    def in_control(self) -> bool:
        """True: every received sample counts as evidence about the active instance."""
        return True

    def attribute(self, instances: Mapping[str, str], active: str) -> None:
        """Set the instances (IP by pod name) and the active one (empty for none).

        Samples received so far are evaluated again. Cheap if nothing changed.
        """
        if active == self._active and instances == self._sources.instances:
            return
        other = active != self._active or instances.get(active) != self._sources.instances.get(active)
        self._sources, self._active = Sources(instances), active
        if other:
            self._lifecycles.forget()
            self._parameters.forget()
        self._presence.forget()
        self._inhabitants.forget()
        for topic in self._topics.values():
            for host, source in topic.sources.items():
                source.accepted = self._accepted(host)
            self._count_again(topic)

    def attribute_writers(self, instances: Mapping[bytes, str]) -> None:
        """Attribute the samples of these writers (by their GIDs) to these pods, whatever their addresses are. Cheap if nothing changed."""
        senders = {gid: named(pod) for gid, pod in instances.items() if pod}
        if senders == self._senders:
            return
        self._senders = senders
        for topic in self._topics.values():
            for known, source in list(topic.sources.items()):
                keys = {senders.get(gid, known) for gid in source.sequences}
                if len(keys) == 1 and (key := keys.pop()) != known and key not in topic.sources:
                    topic.sources[key] = topic.sources.pop(known)  # from before its writers were known
                    source.accepted = self._accepted(key)
            self._count_again(topic)

    @property
    def sources(self) -> Sources:
        """The instances that samples are attributed to, and which of them cannot be distinguished."""
        return self._sources

    def _accepted(self, host: bytes) -> bool:
        """Whether a host's samples count: the host is no instance, or it is (or may be) the active one.

        If two instances cannot be distinguished, samples through the gate are assumed to be from the one that the gate
        lets through.
        """
        candidates = self._sources.candidates(host)
        return not candidates or self._active in candidates

    def _in_control(self, gid: bytes) -> bool:
        """Whether an endpoint belongs (or may belong) to the active instance.

        If no address identifies that instance: whether the endpoint belongs to no other instance.
        """
        if self._own is not None:
            return MIDDLEWARE.host_of(gid) == self._own
        candidates = self._sources.candidates(gid)
        identified = self._active in self._sources.instances and self._active not in self._sources.unknown
        return self._active in candidates if identified else not candidates

    def _count_again(self, topic: _Topic) -> None:
        """Combine the records that count. If only one source counts, its record is used as it is."""
        accepted = [source for source in topic.sources.values() if source.accepted]
        if len(accepted) == 1:
            topic.counted = accepted[0]
            return
        counted = topic.counted = TopicRecord(topic.want.window, topic.want.contents)
        counted.observed_since = self._observed_since
        for arrival in sorted(arrival for source in accepted for arrival in source.arrivals):
            counted.add(arrival)
        counted.count = sum(source.count for source in accepted)
        kept = (content for source in accepted for content in source.contents)
        counted.contents.extend(sorted(kept, key=lambda content: content.received))

    # -- receiving --------------------------------------------------------------------------------------------------

    def drain(self) -> int:
        """Take all samples that have arrived, and return their number."""
        low, high = self._set_clock()
        now = time.monotonic()
        if now - self._drained_at > LONG_STALL:
            self._note_stall()
        elif now - self._drained_at > STALL:
            self._losing_until = now + CATCH_UP
        self._drained_at = now
        if now >= self._next_look_up:
            self._next_look_up = now + TYPE_CHECK_PERIOD
            self._find_types()
            self._forget_servers()
        self._presence.refresh()
        self._inhabitants.refresh()
        taken = 0
        for topic in self._topics.values():
            if topic.subscription is not None:
                taken += self._drain(topic, low, high)
        self._lifecycles.refresh()
        self._parameters.refresh()
        self._drained = time.time()
        return taken

    def _note_stall(self) -> None:
        """Note that samples since the last drain may be lost, or stamped late."""
        self._observed_since = time.time() + CATCH_UP
        for topic in self._topics.values():
            for record in (topic.counted, *topic.sources.values()):
                record.observed_since = self._observed_since

    def _drain(self, topic: _Topic, low: float, high: float) -> int:
        take, sources, handle = self._taker.take, topic.sources, topic.subscription.handle
        bounded = low > -math.inf
        taken = 0
        # Limited, because a writer may be faster than this process.
        most = 4 * depth(topic.want)
        task, wanted = topic.want.task, topic.want.contents
        mixed, track = topic.mixed, topic.track
        needed = None if topic.want.whole else HEAD
        senders = self._senders
        losing = self._drained_at < self._losing_until
        with handle:
            pointer = handle.pointer
            while taken < most and (sample := take(pointer, with_data=task)) is not None:
                taken += 1
                if mixed and ours(self._taker.data(OURS)):
                    continue
                stamped, sent, gid, sequence, data = sample
                received = min(max(stamped, low), high) if bounded else stamped
                sender = senders.get(gid) or MIDDLEWARE.host_of(gid)
                source = sources.get(sender) or self._new_source(topic, sender)
                if track is not None and track.wanted and (source.accepted or not self._records_counted):
                    track.add(received, sent, sequence, data or self._taker.data())
                source.add(received)
                if source.number(gid, sequence, received) and losing:
                    source.observed_since = received
                    if source.accepted:
                        topic.counted.observed_since = received
                if source.accepted and topic.counted is not source:
                    topic.counted.add(received)
                if wanted:
                    kept = self._taker.data(needed)
                    content = Received(received, stamped, kept, topic.message, topic.stamped, sent)
                    source.contents.append(content)
                    if source.accepted and topic.counted is not source:
                        topic.counted.contents.append(content)
                if task:
                    _note_goals(topic.active, gid, received, data)
        return taken

    def _new_source(self, topic: _Topic, host: bytes) -> SourceRecord:
        for old in [host for host, record in topic.sources.items() if (record.last or 0.0) < time.time() - FORGET]:
            del topic.sources[old]
        source = topic.sources[host] = SourceRecord(max(topic.want.window, HISTORY), topic.want.contents)
        source.accepted = self._accepted(host)
        source.observed_since = self._observed_since
        self._count_again(topic)
        return source

    def _set_clock(self) -> tuple[float, float]:
        """Follow a step of the clock. Returns the bounds for the times of samples in the queues.

        Samples received before the step are stamped by the old clock. They arrived after the last drain.
        """
        step = self._steps.taken()
        if not step:
            return -math.inf, math.inf
        _logger.warning("the system clock jumped by %+.3f s; the receive times are corrected by the same amount", step)
        self._drained += step
        self._observed_since += step
        self._presence.shift(step)
        self._inhabitants.shift(step)
        self._lifecycles.shift(step)
        self._parameters.shift(step)
        if self.pod_state is not None:
            self.pod_state.received += step
        for topic in self._topics.values():
            for source in topic.sources.values():
                source.shift(step)
            topic.active = {gid: since + step for gid, since in topic.active.items()}
            self._count_again(topic)
        if self._ring is not None:
            self._ring.shift(step)
        return self._drained, time.time()

    # -- results -----------------------------------------------------------------------------------------------------

    def topic(self, name: str) -> TopicRecord | None:
        """Return the samples that count for the active instance; None if the topic is not watched."""
        topic = self._topics.get(name)
        return topic.counted if topic is not None else None

    def own(self, name: str) -> TopicRecord | None:
        """Return the samples of the active instance itself on a topic; None if there are none (yet)."""
        found = [source for host, source in self.records(name).items() if self._in_control(host)]
        if len(found) < 2:
            return found[0] if found else None
        joined = TopicRecord(contents=sum(len(source.contents) for source in found))
        for arrival in sorted(arrival for source in found for arrival in source.arrivals):
            joined.add(arrival)
        joined.contents.extend(sorted((c for source in found for c in source.contents), key=lambda c: c.received))
        return joined

    def active(self, name: str) -> dict[bytes, float]:
        """Return when each server of an action got its active goal, by the GID of the writer of its status."""
        topic = self._topics.get(name)
        return topic.active if topic is not None else {}

    def task(self, name: str) -> float | None:
        """Return since when the active instance has had an active goal.

        A goal of a process that is no instance, such as a proxy, counts too.
        """
        topic = self._topics.get(name)
        if topic is None:
            return None
        times = [since for gid, since in topic.active.items() if self._accepted(MIDDLEWARE.host_of(gid))]
        return min(times, default=None)

    def publishers(self, name: str) -> Publishers | None:
        """Return the active instance's publishers of a topic; None before the first check."""
        return self._presence.of(name)

    def node(self, name: str) -> NodePresence | None:
        """Return whether the active instance has a node; None before the first check."""
        return self._inhabitants.of(name)

    def lifecycle(self, name: str) -> NodeState | None:
        """Return the state of a managed node of the active instance; None if nothing is known (yet)."""
        return self._lifecycles.of(name)

    def parameter(self, node: str, name: str) -> ParameterState | None:
        """Return the value of a parameter of a node of the active instance; None if nothing is known (yet)."""
        return self._parameters.of((node, name))

    def pod(self) -> PodState | None:
        """Return the state of the active instance's pod; None if it is not known (yet)."""
        return self.pod_state

    def records(self, name: str) -> dict[bytes, SourceRecord]:
        """Return the samples of a topic, by the host part of the senders' GIDs."""
        topic = self._topics.get(name)
        return topic.sources if topic is not None else {}

    def last_from(self, name: str, pod: str) -> float | None:
        """Return when a topic was last received from a pod.

        None for never, or if the pod cannot be distinguished from another.
        """
        record = self._record_of(name, pod)
        return record.last if record is not None else None

    def arrivals(self, name: str, pod: str) -> Sequence[float]:
        """Return when a topic was received from a pod, within HISTORY.

        Empty if the pod cannot be distinguished from another.
        """
        record = self._record_of(name, pod)
        return record.arrivals if record is not None else ()

    def newest_writer(self, name: str, pod: str) -> float:
        """Return when the first sample of a pod's newest writer of a topic was received; 0 if no sample was."""
        record = self._record_of(name, pod)
        return record.newest_writer if record is not None else 0.0

    def processes(self, name: str, pod: str) -> frozenset[bytes]:
        """Return what identifies the processes of a pod from which a topic was received.

        Empty if the pod cannot be distinguished from another.
        """
        record = self._record_of(name, pod)
        return frozenset(map(MIDDLEWARE.process_of, record.sequences)) if record is not None else frozenset()

    def first_from(self, name: str, pod: str, *, since: float) -> float | None:
        """Return when a topic was first received from a pod at or after a time, which must be within HISTORY."""
        record = self._record_of(name, pod)
        if record is None:
            return None
        place = bisect_left(record.arrivals, since)
        return record.arrivals[place] if place < len(record.arrivals) else None

    def last_from_others(self, name: str, pod: str) -> tuple[float, str] | None:
        """Return when a topic was last received from an instance that is certainly not this pod, and from which."""
        found = [
            (record.last, ", ".join(pods))
            for host, record in self.records(name).items()
            if (pods := self._sources.candidates(host)) and pod not in pods and record.last is not None
        ]
        return max(found) if found else None

    def period_of_others(self, name: str, pod: str) -> float:
        """Return the mean time in seconds between two samples of an instance that is certainly not this pod, within HISTORY.

        The longest, if there are several such instances; 0 if none was received.
        """
        found = [
            (record.arrivals[-1] - record.arrivals[0]) / (len(record.arrivals) - 1)
            for host, record in self.records(name).items()
            if (pods := self._sources.candidates(host)) and pod not in pods and len(record.arrivals) > 1
        ]
        return max(found, default=0.0)

    def _record_of(self, name: str, pod: str) -> SourceRecord | None:
        found = [record for key, record in self.records(name).items() if self._sources.candidates(key) == (pod,)]
        return max(found, key=lambda record: record.last or 0.0, default=None)

    def close(self) -> None:
        """Remove all subscriptions. The graph belongs to the caller."""
        for topic in self._topics.values():
            self._end(topic)
        self._topics.clear()
        self._lifecycles.close()
        self._parameters.close()


def _note_goals(active: dict[bytes, float], gid: bytes, received: float, data: bytes) -> None:
    """Note from an action's status (action_msgs/msg/GoalStatusArray) whether one of its goals is active."""
    from rclpy.serialization import deserialize_message

    status = deserialize_message(data, message_class("action_msgs/msg/GoalStatusArray"))
    if any(goal.status in task_activity.ACTIVE_STATUSES for goal in status.status_list):
        active.setdefault(gid, received)
    else:
        active.pop(gid, None)
