"""The leaves of a health tree: what must hold of one topic."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from understudy.trees.observations import Observations, Recorded, TopicRecord
from understudy.trees.rates import Window, hertz

State = Literal["Healthy", "Starting", "Failed"]

STATUS: dict[State, Status] = {"Healthy": Status.SUCCESS, "Starting": Status.RUNNING, "Failed": Status.FAILURE}
"""How a state is said in py_trees."""

STATE: dict[Status, State] = {status: state for state, status in STATUS.items()}
"""How a status of py_trees is said here."""


@dataclass
class Glance:
    """The moment a tree is judged for; one object shared by all its leaves, changed before each tick."""

    grace: float
    """Seconds that an instance has to become healthy for the first time."""
    observations: Observations = field(default_factory=lambda: Recorded({}))
    now: float = 0.0
    """Unix seconds."""
    since: float = 0.0
    """Unix seconds: when the instance that is judged took control. What was received earlier isn't its own."""
    real: bool = True
    """False while a later moment is tried out, which must leave no trace."""


class TopicLeaf(Behaviour):
    """Holds while a topic is received often enough.

    - Gap: failed from the moment at which the last sample is that old.
    - Rate: failed while the count in a full window is outside the band.

    Before the first sample, and for a rate until the band has held for the first time, it is starting, for as long as
    the grace lasts; and in any case until a window has passed since the first sample.
    """

    def __init__(
        self, path: str, topic: str, glance: Glance, *, gap: float | None = None, window: Window | None = None
    ) -> None:
        """A leaf over a topic; ``gap`` in seconds. At least one of gap and window is given."""
        super().__init__(path)
        self.topic = topic
        self.gap = gap
        self.window = window
        self._glance = glance
        self._held: float | None = None
        """The instance (its ``since``) whose rate has been in the band once."""

    def update(self) -> Status:
        """The state at the glance's moment, as py_trees says it."""
        state = self.state()
        if self._glance.real:
            if state == "Healthy":
                self.remember()
            if STATUS[state] != self.status or state == "Failed":
                self.feedback_message = self.reason(state)
        return STATUS[state]

    def state(self) -> State:
        """The state at the glance's moment."""
        states = [self._gap_state()] if self.gap is not None else []
        if self.window is not None:
            states.append(self._rate_state(self.window))
        if "Failed" in states:
            return "Failed"
        return "Starting" if "Starting" in states else "Healthy"

    def remember(self) -> None:
        """Note that the instance has been healthy here: a rate has no more grace then."""
        self._held = self._glance.since

    def healthy_until(self) -> float | None:
        """When it is no longer healthy if nothing more arrives; None where it isn't healthy at the glance's moment.

        The same as :meth:`state` says, by less work: this is what is asked of every leaf at every tick.
        """
        record, now, since = self._glance.observations.topic(self.topic), self._glance.now, self._glance.since
        if record is None or record.last is None or record.last < since:
            return None
        until = record.last + self.gap if self.gap is not None else math.inf
        if self.window is not None:
            arrivals = self._arrivals(record)
            if now < self.window.leaves(arrivals[0]) or self.window.exceeded(arrivals, now):
                return None
            until = min(until, self.window.until(arrivals))
        return until if now < until else None

    def changes(self) -> list[float]:
        """The moments after the glance's at which the state may be another with no further message."""
        record, since = self._record(), self._glance.since
        moments = [since + self._glance.grace]
        if record is not None and record.last is not None:
            if self.gap is not None:
                moments.append(record.last + self.gap)
            if self.window is not None:
                arrivals = self._arrivals(record)
                moments.append(self.window.leaves(arrivals[0]))
                moments.extend(self.window.changes(arrivals))
        return [moment for moment in moments if moment > self._glance.now]

    def last(self) -> float | None:
        """When the instance's last sample was received, in Unix seconds."""
        record = self._record()
        return record.last if record is not None else None

    def reason(self, state: State) -> str:
        """Why it is in this state, in plain words. Says the same for as long as nothing changes."""
        record = self._record()
        if record is None:
            if state == "Starting":
                return f"waiting for the first {self.topic}, for up to {duration(self._glance.grace)}"
            if state == "Failed":
                return f"no {self.topic} within {duration(self._glance.grace)} of the start"
            return f"{self.topic} is silent"
        if state == "Healthy":
            return f"{self.topic} is received"
        if self.gap is not None and self._gap_state() == "Failed":
            return f"no {self.topic} for {duration(self.gap)}"
        assert self.window is not None, "a gap alone fails by the gap"
        if state == "Starting":
            return f"{self.topic} has not been at {self.window.band} for {duration(self.window.length)} yet"
        return self._rate_reason(self.window, self._arrivals(record))

    def _gap_state(self) -> State:
        record, glance = self._record(), self._glance
        if record is None or record.last is None:
            return "Starting" if glance.now < glance.since + glance.grace else "Failed"
        assert self.gap is not None
        return "Healthy" if glance.now < record.last + self.gap else "Failed"

    def _rate_state(self, window: Window) -> State:
        record, glance = self._record(), self._glance
        in_grace = glance.now < glance.since + glance.grace
        if record is None:
            if in_grace:
                return "Starting"
            return "Failed" if window.least else "Healthy"
        arrivals = self._arrivals(record)
        if glance.now < window.leaves(arrivals[0]):
            return "Starting"
        if window.holds(arrivals, glance.now):
            return "Healthy"
        return "Starting" if in_grace and self._held != glance.since else "Failed"

    def _rate_reason(self, window: Window, arrivals: Sequence[float]) -> str:
        now, band = self._glance.now, window.band
        exceeded = window.exceeded(arrivals, now)
        rate, bound = window.rate(arrivals, now), (band.high if exceeded else band.low) or 0
        where = "above" if exceeded else "below"
        if rate == bound:  # A strict bound, just met: "below 8 Hz" would be wrong of 8 Hz.
            where = "not below" if exceeded else "not above"
        return f"{self.topic} at {hertz(rate)}, {where} {hertz(bound)} over {duration(window.length)}"

    def _record(self) -> TopicRecord | None:
        """The topic's record, None without a sample of this instance."""
        record = self._glance.observations.topic(self.topic)
        if record is None or record.last is None or record.last < self._glance.since:
            return None
        return record

    def _arrivals(self, record: TopicRecord) -> Sequence[float]:
        """The instance's arrivals, at least one."""
        arrivals = record.arrivals
        if arrivals[0] >= self._glance.since:
            return arrivals
        return list(arrivals)[bisect_left(arrivals, self._glance.since) :]


def duration(seconds: float) -> str:
    """A length of time in words, such as ``500 ms`` or ``2 s``."""
    return f"{seconds * 1000:.6g} ms" if seconds < 1 else f"{seconds:.6g} s"
