"""The received messages of the last seconds, as bytes: bounded in time, and in memory over all topics.

A message costs a copy of its bytes and an append. Nothing is deserialized or written before a failure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

Message = tuple[float, float, int, bytes]
"""Time of receipt and time of sending (Unix seconds, 0 if that is not known), its number in its writer's sequence, and
CDR with its header."""

OVERHEAD = 200
"""Bytes that a message uses besides its data."""

ROOM = 0.75
"""Fraction of the memory that the time before a failure may use. The rest is for the messages during the recovery."""


class RecordedTopic(NamedTuple):
    """The stored messages of a topic."""

    topic: str
    type: str
    messages: list[Message]


class SampleTrack:
    """The messages of one topic."""

    __slots__ = ("_messages", "_ring", "size", "topic", "type", "wanted")

    def __init__(self, ring: SampleRing, topic: str, type_: str) -> None:
        self._ring = ring
        self.topic, self.type = topic, type_
        self._messages: deque[Message] = deque()
        self.size = 0
        """Bytes that it uses."""
        self.wanted = True
        """Whether messages are stored; otherwise their bytes need not be copied."""

    def add(self, received: float, sent: float, sequence: int, data: bytes) -> None:
        """Store a message, and forget messages that are too old by now."""
        ring, size = self._ring, len(data) + OVERHEAD
        if ring.since is None:
            self.forget(received - ring.seconds)
        if ring.used + size > ring.limit and not ring.make_room(self, received, size):
            return
        self._messages.append((received, sent, sequence, data))
        self.size += size
        ring.used += size

    def forget(self, before: float) -> None:
        """Forget messages that were received before a time."""
        messages, freed = self._messages, 0
        while messages and messages[0][0] < before:
            freed += len(messages.popleft()[3]) + OVERHEAD
        if freed:
            self.size -= freed
            self._ring.used -= freed

    def leave_out(self) -> None:
        """Store nothing of this topic, now and later."""
        self._ring.used -= self.size
        self.size, self.wanted = 0, False
        self._messages.clear()

    def since(self, since: float) -> list[Message]:
        """Return the messages that were received from a time on."""
        return [message for message in self._messages if message[0] >= since]

    def shift(self, step: float) -> None:
        """Move all times with the clock."""
        self._messages = deque((at + step, *rest) for at, *rest in self._messages)  # type: ignore[misc]


class SampleRing:
    """The messages of all topics. Times are Unix seconds by this machine's clock."""

    def __init__(self, seconds: float, memory: int) -> None:
        self.seconds, self._memory = seconds, memory
        self.limit = int(memory * ROOM)
        """Bytes that it may use now."""
        self.used = 0
        """Bytes that it uses."""
        self.since: float | None = None
        """Since when all messages are kept, after a failure; None if old messages are forgotten."""
        self.full: float | None = None
        """Since when messages were missed after the failure because memory was exhausted; None if none were missed."""
        self._tracks: dict[str, SampleTrack] = {}

    def track(self, topic: str, type_: str) -> SampleTrack:
        """Return the track for a topic's messages."""
        found = self._tracks.get(topic)
        if found is None or found.type != type_:
            if found is not None:
                found.leave_out()
            self._tracks[topic] = found = SampleTrack(self, topic, type_)
        return found

    @property
    def left_out(self) -> Mapping[str, str]:
        """Return the topics that are not stored, and why, as text for users."""
        why = f"in {self.seconds:g} s it takes more than all topics may together"
        return {name: why for name, track in sorted(self._tracks.items()) if not track.wanted}

    def make_room(self, track: SampleTrack, received: float, size: int) -> bool:
        """Whether ``size`` more bytes of a topic can be stored.

        If necessary, the topic that uses most is left out from now on.
        """
        if self.since is not None:
            self.full = self.full or received  # messages from before the failure are worth more than later ones
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
        """Keep all messages from the time before a failure on, as far as there is memory, until :meth:`release`."""
        if self.since is None:
            self.since, self.full, self.limit = failed - self.seconds, None, self._memory

    def release(self) -> None:
        """Forget old messages again."""
        self.since, self.full, self.limit = None, None, int(self._memory * ROOM)

    def taken(self, since: float) -> Iterator[RecordedTopic]:
        """Yield the stored messages of each topic from a time on."""
        for track in self._tracks.values():
            if messages := track.since(since):
                yield RecordedTopic(track.topic, track.type, messages)

    def shift(self, step: float) -> None:
        """Move all times with the clock."""
        if self.since is not None:
            self.since += step
        for track in self._tracks.values():
            track.shift(step)
