"""What a health tree evaluates: when messages of which topics were received, and their last contents.

The tree knows the protocol only. :class:`TopicRecord` and :class:`RecordedObservations` are the plain implementation that the
drained subscriptions of ``understudy.ros`` fill, and that tests fill by hand.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol


class Evidence(Protocol):
    """Something that was received or observed, with its time."""

    received: float
    """When it was, in Unix seconds; moved where the clock was set."""


class Content(Evidence, Protocol):
    """A message that was received."""

    def message(self) -> object:
        """The message with its fields as attributes. Raises Unreadable."""
        ...

    def age(self) -> float | None:
        """How old its header's stamp was when it was received, in seconds; None if it has none."""
        ...

    def under_way(self) -> float | None:
        """How long it was under way, in seconds: from when its writer's middleware says it was written to its receipt; None if
        that says nothing.
        """
        ...

    def older(self, stamp: float) -> float:
        """How much earlier than its receipt a stamp within it is, in seconds; ``stamp`` in Unix seconds."""
        ...

    def mentions(self, text: str) -> bool:
        """Whether it may have this text in it: what has not need not be read."""
        ...

    def byte(self, place: int) -> int | None:
        """A byte of it, serialized (CDR with its header of 4 bytes); None if that is not known."""
        ...


class Unreadable(ValueError):
    """A message is not of the expected type; the text says why."""


@dataclass(eq=False)
class Publishers:
    """The publishers of a topic, as observed in the ROS graph."""

    received: float
    """When it was, in Unix seconds; moved where the clock was set."""
    nodes: Sequence[str]
    """The node of each publisher of the active instance, fully qualified; empty if it is not known yet."""


@dataclass(eq=False)
class NodePresence:
    """Whether a node exists, as observed in the ROS graph."""

    received: float
    """When it was, in Unix seconds; moved where the clock was set."""
    node: str
    """Its name, fully qualified."""
    there: bool
    """Whether the active instance had it."""
    elsewhere: bool = False
    """Whether anybody had one of that name."""


@dataclass(eq=False)
class NodeState:
    """The known state of a managed node of the active instance."""

    received: float
    """When it was so, in Unix seconds; moved where the clock was set."""
    state: str | None
    """Its state; empty if it is not there, None if it cannot be determined."""


class PodCondition(NamedTuple):
    """A condition of a pod's status (Kubernetes' PodCondition)."""

    type: str
    status: str
    """True, False or Unknown."""
    reason: str = ""
    """Why, as one word; empty if it is not said."""


class PodUsage(NamedTuple):
    """The CPU and memory that the containers of a pod use together, without the agent."""

    cpu: float
    """Cores, on the average of some time."""
    memory: float
    """Bytes: the working set, by which the kubelet evicts."""


@dataclass(eq=False)
class PodState:
    """The last observed state of the active instance's pod."""

    received: float
    """When it was, in Unix seconds; moved where the clock was set."""
    conditions: Sequence[PodCondition] = ()
    restarts: int = 0
    """How often its containers were started again, all together."""
    usage: PodUsage | None = None
    """What it takes; None if that cannot be determined, or nobody asked for it."""


ParameterValue = bool | int | float | str
"""What a parameter can be, but for arrays."""


@dataclass(eq=False)
class ParameterState:
    """The known value of a parameter of a node of the active instance."""

    received: float
    """When it was so, in Unix seconds; moved where the clock was set."""
    value: ParameterValue | None
    """Its value; None if it has none, or if that cannot be determined."""
    lacks: str = ""
    """Why it has no value, in words."""
    told: bool = True
    """Whether its value can be determined."""


GAPS = 60.0
"""Seconds for which the longest gap is known at least, which is as often as metrics are asked for."""


class TopicRecord:
    """When a topic was received. Times are Unix seconds."""

    __slots__ = ("_gap", "_gap_before", "_until", "arrivals", "contents", "count", "last", "window")

    def __init__(self, window: float = 0.0, contents: int = 0) -> None:
        """``contents`` is how many of the last messages are kept to be looked into."""
        self.window = window
        """How far back arrivals are needed, in seconds; 0 if only the last one is."""
        self.last: float | None = None
        """When the last sample was received."""
        self.count = 0
        """Samples received in all."""
        self.arrivals: deque[float] = deque()
        """Times within the window, oldest first, and one before it, which tells that the window has been full."""
        self.contents: deque[Content] = deque(maxlen=contents)
        """The last messages, oldest first."""
        self._gap, self._gap_before, self._until = 0.0, 0.0, 0.0

    def longest_gap(self, now: float) -> float | None:
        """The longest time between two samples of the last minute or two, the present silence included; None before the first."""
        if self.last is None:
            return None
        silence = now - self.last
        known = (self._gap, self._gap_before) if now < self._until else (self._gap,) if now < self._until + GAPS else ()
        return max(0.0, silence, *known)

    def add(self, received: float) -> None:
        """Note a sample that was received at this time; late ones find their place."""
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
        """Move all times, after the clock they were taken from was set."""
        if self.last is not None:
            self.last += seconds
        self._until += seconds
        self.arrivals = deque(time + seconds for time in self.arrivals)
        for content in self.contents:
            content.received += seconds


class Observations(Protocol):
    """What has been received so far."""

    @property
    def in_control(self) -> bool:
        """Whether the instance that is judged is the one in control, so that what the robot does is its doing."""
        ...

    def topic(self, name: str) -> TopicRecord | None:
        """The record of a topic, None if it is not watched (yet)."""
        ...

    def own(self, name: str) -> TopicRecord | None:
        """The record of what the active instance sent on a topic, and nobody else; None if it sent nothing (yet)."""
        ...

    def task(self, name: str) -> float | None:
        """Since when the action of this status topic has had an active goal (Unix seconds); None while it has none."""
        ...

    def publishers(self, name: str) -> Publishers | None:
        """Who published a topic at the last look; None if nobody has looked (yet)."""
        ...

    def node(self, name: str) -> NodePresence | None:
        """Whether a node was there at the last look; None if nobody has looked (yet)."""
        ...

    def lifecycle(self, name: str) -> NodeState | None:
        """The state of a managed node; None if nothing is known (yet)."""
        ...

    def parameter(self, node: str, name: str) -> ParameterState | None:
        """The value of a node's parameter; None if nothing is known (yet)."""
        ...

    def pod(self) -> PodState | None:
        """The pod of the active instance at the last look; None if nobody has looked (yet), or can."""
        ...


class RecordedObservations:
    """Observations from mappings of records."""

    in_control = True

    def __init__(
        self,
        topics: Mapping[str, TopicRecord],
        tasks: Mapping[str, float] | None = None,
        publishers: Mapping[str, Publishers] | None = None,
        nodes: Mapping[str, NodePresence] | None = None,
        states: Mapping[str, NodeState] | None = None,
        parameters: Mapping[tuple[str, str], ParameterState] | None = None,
        pod: PodState | None = None,
    ) -> None:
        """``tasks`` has when each active action became so, by its status topic."""
        self._topics = topics
        self._tasks = tasks if tasks is not None else {}
        self._publishers = publishers if publishers is not None else {}
        self._nodes = nodes if nodes is not None else {}
        self._states = states if states is not None else {}
        self._parameters = parameters if parameters is not None else {}
        self._pod = pod

    def topic(self, name: str) -> TopicRecord | None:
        """The record of a topic, None if there is none."""
        return self._topics.get(name)

    def own(self, name: str) -> TopicRecord | None:
        """The same: everything recorded is the instance's."""
        return self._topics.get(name)

    def task(self, name: str) -> float | None:
        """When the action became active, None while it is not."""
        return self._tasks.get(name)

    def publishers(self, name: str) -> Publishers | None:
        """Who published the topic, None if nobody has looked."""
        return self._publishers.get(name)

    def node(self, name: str) -> NodePresence | None:
        """Whether the node was there, None if nobody has looked."""
        return self._nodes.get(name)

    def lifecycle(self, name: str) -> NodeState | None:
        """The state of the node, None if nothing is known."""
        return self._states.get(name)

    def parameter(self, node: str, name: str) -> ParameterState | None:
        """The value of the parameter, None if nothing is known."""
        return self._parameters.get((node, name))

    def pod(self) -> PodState | None:
        """The pod, None if nobody has looked."""
        return self._pod


@dataclass
class Evaluation:
    """The instant and the observations of an evaluation; all leaves of a tree share one, which is changed before each tick."""

    grace: float
    """Seconds that an instance has to become healthy for the first time."""
    observations: Observations = field(default_factory=lambda: RecordedObservations({}))
    now: float = 0.0
    """Unix seconds."""
    since: float = 0.0
    """Unix seconds: when the instance that is judged took control. What was received earlier is not its own."""
    begun: float = -math.inf
    """Unix seconds: since when the tree is judged by. What it names again may not have been watched before."""
    real: bool = True
    """False while a later moment is tried out, which must leave no trace."""

    @property
    def in_time(self) -> float:
        """Until when the instance may become healthy for the first time, in Unix seconds."""
        return max(self.since, self.begun) + self.grace
