"""What a health tree looks at: which topics were received when.

The tree knows the protocol only. :class:`TopicRecord` and :class:`Recorded` are the plain implementation that the
drained subscriptions of ``understudy.ros`` fill, and that tests fill by hand.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Mapping
from typing import Protocol


class TopicRecord:
    """When a topic was received. Times are Unix seconds."""

    __slots__ = ("arrivals", "count", "last", "window")

    def __init__(self, window: float = 0.0) -> None:
        self.window = window
        """How far back arrivals are needed, in seconds; 0 where only the last one is."""
        self.last: float | None = None
        """When the last sample was received."""
        self.count = 0
        """Samples received in all."""
        self.arrivals: deque[float] = deque()
        """Times within the window, oldest first, and one before it, which tells that the window has been full."""

    def add(self, received: float) -> None:
        """Note a sample that was received at this time; late ones find their place."""
        self.count += 1
        arrivals = self.arrivals
        if self.last is None or received >= self.last:
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
        self.arrivals = deque(time + seconds for time in self.arrivals)


class Observations(Protocol):
    """What has been received so far."""

    def topic(self, name: str) -> TopicRecord | None:
        """The record of a topic, None where it isn't watched (yet)."""
        ...


class Recorded:
    """Observations out of a mapping of records."""

    def __init__(self, topics: Mapping[str, TopicRecord]) -> None:
        self._topics = topics

    def topic(self, name: str) -> TopicRecord | None:
        """The record of a topic, None where there is none."""
        return self._topics.get(name)
