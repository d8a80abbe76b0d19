"""The last seconds of what was received, as the bytes that came: bounded by time, and by memory over all topics.

A message costs a copy of its bytes and an append. Nothing is read, and nothing is written, before something has failed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

Message = tuple[float, float, int, bytes]
"""When it was received and when it was sent (Unix seconds, 0 if that is not known), its number in its writer's sequence, and CDR
with its header."""

OVERHEAD = 200
"""Bytes that a message takes beside its data."""

ROOM = 0.75
"""Share of the memory that the time before a failure may take; the rest is for what comes while it is dealt with."""


class Taken(NamedTuple):
    """What was kept of a topic."""

    topic: str
    type: str
    messages: list[Message]


class SampleTrack:
    """One topic."""

    __slots__ = ("_messages", "_ring", "size", "topic", "type", "wanted")

    def __init__(self, ring: SampleRing, topic: str, type_: str) -> None:
        self._ring = ring
        self.topic, self.type = topic, type_
        self._messages: deque[Message] = deque()
        self.size = 0
        """Bytes that it takes."""
        self.wanted = True
        """Whether it is kept; its bytes need not be copied if it is not."""

    def add(self, received: float, sent: float, sequence: int, data: bytes) -> None:
        """Keep a message, and forget what is too old by now."""
        ring, size = self._ring, len(data) + OVERHEAD
        if ring.since is None:
            self.forget(received - ring.seconds)
        if ring.used + size > ring.limit and not ring.make_room(self, received, size):
            return
        self._messages.append((received, sent, sequence, data))
        self.size += size
        ring.used += size

    def forget(self, before: float) -> None:
        """Forget what was received before a time."""
        messages, freed = self._messages, 0
        while messages and messages[0][0] < before:
            freed += len(messages.popleft()[3]) + OVERHEAD
        if freed:
            self.size -= freed
            self._ring.used -= freed

    def leave_out(self) -> None:
        """Keep nothing of it, now and later."""
        self._ring.used -= self.size
        self.size, self.wanted = 0, False
        self._messages.clear()

    def since(self, since: float) -> list[Message]:
        """What was received from a time on."""
        return [message for message in self._messages if message[0] >= since]

    def shift(self, step: float) -> None:
        """Move its times with the clock."""
        self._messages = deque((at + step, *rest) for at, *rest in self._messages)  # type: ignore[misc]


class SampleRing:
    """All topics. Times are Unix seconds by this machine's clock."""

    def __init__(self, seconds: float, memory: int) -> None:
        self.seconds, self._memory = seconds, memory
        self.limit = int(memory * ROOM)
        """Bytes that it may take now."""
        self.used = 0
        """Bytes that it takes."""
        self.since: float | None = None
        """Since when all is kept, while that is so."""
        self.full: float | None = None
        """From when on messages were missed then, for want of memory; None for none."""
        self._tracks: dict[str, SampleTrack] = {}

    def track(self, topic: str, type_: str) -> SampleTrack:
        """Where a topic's messages go."""
        found = self._tracks.get(topic)
        if found is None or found.type != type_:
            if found is not None:
                found.leave_out()
            self._tracks[topic] = found = SampleTrack(self, topic, type_)
        return found

    @property
    def left_out(self) -> Mapping[str, str]:
        """The topics that are not kept, and why, in plain words."""
        why = f"in {self.seconds:g} s it takes more than all topics may together"
        return {name: why for name, track in sorted(self._tracks.items()) if not track.wanted}

    def make_room(self, track: SampleTrack, received: float, size: int) -> bool:
        """Whether so many bytes more can be kept of a topic; where need be, the topic that takes most is left out."""
        if self.since is not None:
            self.full = self.full or received  # what led to the failure is worth more than what came of it
            return False
        for each in self._tracks.values():
            each.forget(received - self.seconds)
        while self.used + size > self.limit:
            most = max(self._tracks.values(), key=lambda each: each.size + (size if each is track else 0))
            most.leave_out()
            if most is track:
                return False
        return True

    def hold(self, failed: float) -> None:
        """Keep all from the time before a failure on, as far as there is memory, until it is let go."""
        if self.since is None:
            self.since, self.full, self.limit = failed - self.seconds, None, self._memory

    def let_go(self) -> None:
        """Forget again what is too old."""
        self.since, self.full, self.limit = None, None, int(self._memory * ROOM)

    def taken(self, since: float) -> Iterator[Taken]:
        """What was kept of each topic from a time on."""
        for track in self._tracks.values():
            if messages := track.since(since):
                yield Taken(track.topic, track.type, messages)

    def shift(self, step: float) -> None:
        """Move all times with the clock."""
        if self.since is not None:
            self.since += step
        for track in self._tracks.values():
            track.shift(step)
