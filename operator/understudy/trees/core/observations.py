"""The input of a health tree: when messages of each topic were received, and their last contents.

The tree knows only the protocol. :class:`TopicRecord` and :class:`RecordedObservations` are the plain implementation,
which the drained subscriptions of ``understudy.ros`` fill, and which tests fill by hand.
"""

from __future__ import annotations

import itertools
import math
import statistics
from bisect import insort
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol


class Evidence(Protocol):
    """Something that was received or observed, with its time."""

    received: float
    """When it was received or observed, in Unix seconds; moved if the clock was set."""


class Answer(Evidence, Protocol):
    """What a node reports about itself."""

    @property
    def is_known(self) -> bool:
        """Whether it can be determined."""
        ...


class Content(Evidence, Protocol):
    """A message that was received."""

    def message(self) -> object:
        """Return the message with its fields as attributes. Raises Unreadable."""
        ...

    def age(self) -> float | None:
        """Return the age of its header's stamp when it was received, in seconds; None if it has none."""
        ...

    def under_way(self) -> float | None:
        """Return the seconds from its writing, by the source timestamp of its writer's middleware, to its receipt; None
        if there is no such timestamp."""
        ...

    def older(self, stamp: float) -> float:
        """Return the seconds from a stamp inside it to its receipt; ``stamp`` is in Unix seconds."""
        ...

    def mentions(self, text: str) -> bool:
        """Return whether it may contain this text. A message without it need not be deserialized."""
        ...

    def byte(self, place: int) -> int | None:
        """Return one byte of the serialized message (CDR with its header of 4 bytes); None if it is not known."""
        ...


class Unreadable(ValueError):
    """A message is not of the expected type; the text says why."""


@dataclass(eq=False)
class Publishers:
    """The publishers of a topic, as observed in the ROS graph."""

    received: float
    """When they were observed, in Unix seconds; moved if the clock was set."""
    nodes: Sequence[str]
    """The node of each publisher of the active instance, fully qualified; empty if it is not known yet."""


@dataclass(eq=False)
class NodePresence:
    """Whether a node exists, as observed in the ROS graph."""

    received: float
    """When it was observed, in Unix seconds; moved if the clock was set."""
    node: str
    """Its name, fully qualified."""
    there: bool
    """Whether the active instance had it."""
    elsewhere: bool = False
    """Whether anything else had a node of that name."""


@dataclass(eq=False)
class NodeState:
    """The known state of a managed node of the active instance."""

    received: float
    """When the node was in this state, in Unix seconds; moved if the clock was set."""
    state: str | None
    """Its state; empty if the node does not exist, None if it cannot be determined."""

    @property
    def is_known(self) -> bool:
        """Whether its state can be determined."""
        return self.state is not None


class PodCondition(NamedTuple):
    """A condition of a pod's status (Kubernetes' PodCondition)."""

    type: str
    status: str
    """True, False or Unknown."""
    reason: str = ""
    """The reason as one word; empty if it is not stated."""


class PodUsage(NamedTuple):
    """The CPU and memory that the containers of a pod use together, without the agent."""

    cpu: float
    """Cores, averaged over some time."""
    memory: float
    """Bytes of the working set, which the kubelet uses for evictions."""


@dataclass(eq=False)
class PodState:
    """The last observed state of the active instance's pod."""

    received: float
    """When it was observed, in Unix seconds; moved if the clock was set."""
    conditions: Sequence[PodCondition] = ()
    restarts: int = 0
    """The number of restarts of its containers, all together."""
    usage: PodUsage | None = None
    """Its usage; None if it cannot be determined, or if no leaf needs it."""


ParameterValue = bool | int | float | str
"""Possible values of a parameter, except arrays."""


@dataclass(eq=False)
class ParameterState:
    """The known value of a parameter of a node of the active instance."""

    received: float
    """When it had this value, in Unix seconds; moved if the clock was set."""
    value: ParameterValue | None
    """Its value; None if it has none, or if it cannot be determined."""
    lacks: str = ""
    """Why it has no value, in words."""
    is_known: bool = True
    """Whether its value can be determined."""


INTERVALS = 15
"""Times between samples that show how often a sender sends. A few of them may be different."""

GAPS = 60.0
"""Minimum seconds for which the longest gap is kept: the interval at which metrics are scraped."""


class TopicRecord:
    """When a topic was received. Times are Unix seconds."""

    __slots__ = ("_gap", "_gap_before", "_until", "arrivals", "contents", "count", "last", "observed_since", "window")

    def __init__(self, window: float = 0.0, contents: int = 0) -> None:
        """``contents`` is the number of last messages that are kept for evaluation."""
        self.window = window
        """Seconds for which arrivals are kept; 0 if only the last one is needed."""
        self.last: float | None = None
        """When the last sample was received."""
        self.count = 0
        """Number of all samples received."""
        self.arrivals: deque[float] = deque()
        """Times within the window, oldest first, and one before it, which shows that the window has been full."""
        self.contents: deque[Content] = deque(maxlen=contents)
        """The last messages, oldest first."""
        self.observed_since = -math.inf
        """Since when no sample can be missing because the observer was stalled. A rate counts from then on only."""
        self._gap, self._gap_before, self._until = 0.0, 0.0, 0.0

    def longest_gap(self, now: float) -> float | None:
        """Return the longest time between two samples of the last minute or two, including the present silence; None
        before the first."""
        if self.last is None:
            return None
        silence = now - self.last
        known = (self._gap, self._gap_before) if now < self._until else (self._gap,) if now < self._until + GAPS else ()
        return max(0.0, silence, *known)

    @property
    def interval(self) -> float:
        """Return the seconds that usually pass between two samples: the median of the last ones.

        Infinite before the third: two samples may be of two moments that have nothing in common.
        """
        newest_first = itertools.islice(reversed(self.arrivals), INTERVALS + 1)
        between = [after - before for after, before in itertools.pairwise(newest_first)]
        return statistics.median(between) if len(between) > 1 else math.inf

    def add(self, received: float) -> None:
        """Note a sample that was received at this time. Late ones are inserted in order."""
        self.count += 1
        arrivals = self.arrivals
        if self.last is None or received >= self.last:
            if received >= self._until:
                self._gap_before = self._gap if received < self._until + GAPS else 0.0
                self._gap, self._until = 0.0, received + GAPS
            if self.last is not None and received - self.last > self._gap:
                self._gap = received - self.last
            self.last = received
            arrivals.append(received)
        else:
            insort(arrivals, received)
        while len(arrivals) > 1 and arrivals[1] + self.window <= self.last:
            arrivals.popleft()

    def shift(self, seconds: float) -> None:
        """Move all times, after the clock was set."""
        if self.last is not None:
            self.last += seconds
        self._until += seconds
        self.observed_since += seconds
        self.arrivals = deque(time + seconds for time in self.arrivals)
        for content in self.contents:
            content.received += seconds


class Observations(Protocol):
    """What has been received so far."""

    @property
    def in_control(self) -> bool:
        """Whether the judged instance is the active one, so that it causes what the robot does."""
        ...

    def topic(self, name: str) -> TopicRecord | None:
        """Return the record of a topic; None if it is not watched (yet)."""
        ...

    def own(self, name: str) -> TopicRecord | None:
        """Return the record of what only the active instance sent on a topic; None if it sent nothing (yet)."""
        ...

    def task(self, name: str) -> float | None:
        """Return since when the action of this status topic has had an active goal (Unix seconds); None while it has
        none."""
        ...

    def publishers(self, name: str) -> Publishers | None:
        """Return who published a topic at the last observation; None before the first."""
        ...

    def node(self, name: str) -> NodePresence | None:
        """Return whether a node existed at the last observation; None before the first."""
        ...

    def lifecycle(self, name: str) -> NodeState | None:
        """Return the state of a managed node; None if nothing is known (yet)."""
        ...

    def parameter(self, node: str, name: str) -> ParameterState | None:
        """Return the value of a node's parameter; None if nothing is known (yet)."""
        ...

    def pod(self) -> PodState | None:
        """Return the pod of the active instance at the last observation; None before the first, or if pods cannot be
        observed."""
        ...


class RecordedObservations:
    """Observations of recorded messages, without a graph, nodes or pods."""

    in_control = True

    def __init__(self, topics: Mapping[str, TopicRecord], tasks: Mapping[str, float] | None = None) -> None:
        """``tasks`` maps the status topic of each active action to the time at which it became active."""
        self._topics, self._tasks = topics, tasks if tasks is not None else {}

    def topic(self, name: str) -> TopicRecord | None:
        """Return the record of a topic; None if there is none."""
        return self._topics.get(name)

    own = topic
    """Everything recorded belongs to the instance."""

    def task(self, name: str) -> float | None:
        """Return when the action became active; None while it is not."""
        return self._tasks.get(name)

    def publishers(self, name: str) -> Publishers | None:
        """Return None: the ROS graph is not observed."""
        return None

    def node(self, name: str) -> NodePresence | None:
        """Return None: the ROS graph is not observed."""
        return None

    def lifecycle(self, name: str) -> NodeState | None:
        """Return None: nodes are not asked."""
        return None

    def parameter(self, node: str, name: str) -> ParameterState | None:
        """Return None: nodes are not asked."""
        return None

    def pod(self) -> PodState | None:
        """Return None: pods are not observed."""
        return None


HEARD_WITHIN = 5.0
"""Seconds within which an instance that already sends is heard by an observer that has discovered one of its outputs. DDS participants
announce themselves every 3 s, so that what was lost of the first announcements is discovered then; the rest is for busy machines."""


@dataclass
class Evaluation:
    """The time and the observations of an evaluation. All leaves of a tree share one, which is changed before each
    tick."""

    grace: float
    """Seconds within which an instance must become healthy for the first time."""
    observations: Observations = field(default_factory=lambda: RecordedObservations({}))
    now: float = 0.0
    """Unix seconds."""
    since: float = 0.0
    """When the judged instance took control, in Unix seconds. What was received earlier is not from it."""
    in_use_since: float = -math.inf
    """Since when this tree is in use, in Unix seconds. Topics that it newly names may not have been watched before."""
    real: bool = True
    """False while a later time is tried, which must leave no trace."""

    expected_since: float = math.nan
    """The instance (its ``since``) that had been healthy before it was observed; NaN for none."""
    heard_from: float = math.inf
    """Since when that instance can be heard, in Unix seconds."""

    @property
    def is_expected(self) -> bool:
        """Whether the instance had been healthy before it was observed. It needs no time to start, but only to be heard."""
        return self.expected_since == self.since

    @property
    def began(self) -> float:
        """When the instance, or this tree, was new, in Unix seconds."""
        return max(self.since, self.in_use_since)

    @property
    def in_time(self) -> float:
        """Until when the instance may become healthy for the first time, in Unix seconds."""
        return self.began + self.grace

    def first_by(self, interval: float) -> float:
        """Return until when a topic may arrive for the first time, in Unix seconds, if its messages may be ``interval`` seconds apart."""
        if not self.is_expected:
            return self.in_time
        return min(self.in_time, self.heard_from + max(HEARD_WITHIN, interval))
