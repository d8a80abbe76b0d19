"""A reader with exclusive ownership, as robots and monitors have it where there is a reflex: it takes the strongest writer that
it hears, and the next one when that was silent for the deadline (DDS 1.4, 2.2.3.9 and 2.2.3.7).

Samples aren't simulated one by one. A writer has a phase and sends every PERIOD from then on; what a reader takes of it
is kept as spans, from the first sample to the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

PERIOD = 0.05
"""Seconds between two samples of a writer."""

HISTORY = 3.0
"""Seconds for which a reader is asked what it took; what is asked for looks at two seconds at most."""

_MOMENT = 1e-6
"""Seconds within which two times are the same."""


@dataclass(frozen=True, eq=False)
class Writer:
    """A process that sends."""

    pod: str
    """Its UID."""
    strength: int
    phase: float

    def first(self, since: float) -> float:
        """Its first sample at or after a time."""
        return self.phase + math.ceil((since - self.phase - _MOMENT) / PERIOD) * PERIOD

    def last(self, until: float) -> float:
        """Its last sample at or before a time."""
        return self.phase + math.floor((until - self.phase + _MOMENT) / PERIOD) * PERIOD


@dataclass
class Span:
    """Samples of a writer that were taken one after the other."""

    writer: Writer
    first: float
    last: float | None = None
    """None while it goes on."""

    def until(self, now: float) -> float:
        """The last one by now."""
        return self.last if self.last is not None else max(self.first, self.writer.last(now))


class Reader:
    """One reader of one output. Times are unix seconds."""

    def __init__(
        self,
        deadline: float,
        clock: Callable[[], float],
        later: Callable[..., None],
        changed: Callable[[], None],
    ) -> None:
        """``later`` does something after so many seconds; ``changed`` is called when it takes another one than before."""
        self._deadline, self._clock, self._later, self._changed = deadline, clock, later, changed
        self._received: dict[str, Writer] = {}
        self._spans: dict[str, list[Span]] = {}
        self._owner: Writer | None = None

    @property
    def driver(self) -> str:
        """The pod whose samples it takes now; empty where none come."""
        owner = self._owner
        return owner.pod if owner is not None and self._open(owner) is not None else ""

    def last(self, pod: str) -> float | None:
        """When a sample of a pod was last taken; now while it takes them."""
        spans = self._spans.get(pod)
        if not spans:
            return None
        return self._clock() if spans[-1].last is None else spans[-1].last

    def first(self, pod: str, since: float) -> float | None:
        """When a sample of a pod was first taken at or after a time."""
        for span in self._spans.get(pod, ()):
            first = max(span.first, span.writer.first(since))
            if first <= span.until(self._clock()):
                return first
        return None

    def arrivals(self, pod: str) -> list[float]:
        """When samples of a pod were taken, of late."""
        now = self._clock()
        found: list[float] = []
        for span in self._spans.get(pod, ()):
            until, at = span.until(now), span.first
            if until < now - HISTORY:
                continue
            at = max(at, span.writer.first(now - HISTORY))
            found += [at + PERIOD * number for number in range(round((until - at) / PERIOD) + 1)]
        return found

    # -- what comes -------------------------------------------------------------------------------------------------

    def hear(self, pod: str, writer: Writer | None, *, left: bool = False) -> None:
        """What comes from a pod: samples of this writer, or none. ``left``: the writer has said that it ends."""
        before = self._received.get(pod)
        if before is not writer:
            if before is not None:
                self._ends(before)
            if writer is not None:
                self._received[pod] = writer
                self._await(writer)
        if left and self._owner is not None and self._owner.pod == pod and self._owner is not writer:
            self._give_up()

    def _ends(self, writer: Writer) -> None:
        del self._received[writer.pod]
        if (span := self._open(writer)) is not None:
            span.last = span.until(self._clock())
            self._later(span.last + self._deadline - self._clock(), self._missed, writer)

    def _open(self, writer: Writer) -> Span | None:
        spans = self._spans.get(writer.pod)
        return spans[-1] if spans and spans[-1].last is None and spans[-1].writer is writer else None

    def _await(self, writer: Writer) -> None:
        now = self._clock()
        self._later(max(0.0, writer.first(now) - now), self._sample, writer)

    def _missed(self, writer: Writer) -> None:
        if self._owner is not writer or self._open(writer) is not None:
            return
        if self._clock() - self._spans[writer.pod][-1].until(0.0) >= self._deadline - _MOMENT:
            self._give_up()

    def _give_up(self) -> None:
        self._owner = None
        for writer in list(self._received.values()):
            self._await(writer)

    def _sample(self, writer: Writer) -> None:
        owner = self._owner
        if self._received.get(writer.pod) is not writer or self._open(writer) is not None:
            return
        if owner is not None and owner is not writer and _rank(writer) < _rank(owner):
            return
        now = self._clock()
        if owner is not None and owner is not writer and (span := self._open(owner)) is not None:
            span.last = span.until(now)
        self._owner = writer
        spans = [span for span in self._spans.get(writer.pod, ()) if span.until(now) >= now - HISTORY]
        self._spans[writer.pod] = [*spans, Span(writer, now)]
        self._changed()


def _rank(writer: Writer) -> tuple[int, str]:
    """Of two that are as strong the GUID decides."""
    return writer.strength, writer.pod
