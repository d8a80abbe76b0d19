"""The leaves of a health tree: what must hold of one topic."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from typing import Literal

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from understudy.trees.core.observations import Glance, TopicRecord
from understudy.trees.core.rate_window import Window, hertz
from understudy.trees.core.task_activity import Situation, TaskActive, situation

State = Literal["Healthy", "Starting", "Failed"]

STATUS: dict[State, Status] = {"Healthy": Status.SUCCESS, "Starting": Status.RUNNING, "Failed": Status.FAILURE}
"""How a state is said in py_trees."""

STATE: dict[Status, State] = {status: state for state, status in STATUS.items()}
"""How a status of py_trees is said here."""


class Leaf(Behaviour, ABC):
    """What must hold of one topic, of the instance that the glance is for.

    One that is for a task isn't judged while that isn't active. Its clocks begin when it becomes active at the earliest,
    and it has some time to start then.
    """

    hears = True
    """Whether it judges by the topic's messages."""
    kind = ""
    """What it is called in the short form, where its class isn't."""
    blind = ""
    """Why it holds though it can't judge, which is no failure: a mistake in itself, in words. Empty where it can."""
    of_cluster = False
    """Whether only who watches the cluster can tell it, and the ROS graph doesn't."""

    def __init__(self, path: str, topic: str, glance: Glance, tasks: Sequence[TaskActive]) -> None:
        super().__init__(path)
        self.topic = topic
        self.tasks = tasks
        self._glance = glance

    def update(self) -> Status:
        """The state at the glance's moment, as py_trees says it."""
        state = self.state()
        if self._glance.real:
            if state == "Healthy":
                self.remember()
            if STATUS[state] != self.status or state == "Failed":
                self.feedback_message = self.reason(state)
        return STATUS[state]

    def counts(self) -> bool:
        """Whether it is judged at the glance's moment: unless it is for a task that isn't active."""
        return not self.tasks or situation(self.tasks, self._glance) is not None

    @property
    def unrecorded(self) -> str:
        """Why a recording of messages doesn't tell it, in words; empty where one does."""
        return "" if self.hears else "it is told by the live ROS graph, which a bag doesn't have"

    def reason(self, state: State) -> str:
        """Why it is in this state, in plain words. Says the same for as long as nothing changes."""
        if self.tasks and state == "Failed":
            actions = " and of ".join(dict.fromkeys(task.action for task in self.tasks))
            return f"{self._plain_reason(state)} while a goal of {actions} is active"
        return self._plain_reason(state)

    def remember(self) -> None:
        """Note that the instance has been healthy here."""

    @abstractmethod
    def state(self) -> State:
        """The state at the glance's moment."""

    @abstractmethod
    def healthy_until(self) -> float | None:
        """When it is no longer healthy if nothing more arrives; None where it isn't healthy at the glance's moment.

        The same as :meth:`state` says, by less work: this is what is asked of every leaf at every tick.
        """

    @abstractmethod
    def changes(self) -> list[float]:
        """The moments after the glance's at which the state may be another with no further message."""

    @abstractmethod
    def last(self) -> float | None:
        """When all was last well, in Unix seconds: a message was received that says so, or its task became active."""

    @abstractmethod
    def _plain_reason(self, state: State) -> str:
        """The reason without the task that it is for."""

    def _last_with_task(self, last: float | None) -> float | None:
        """When all was last well by the messages, or by the task's start, which is later."""
        if not self.tasks or (found := situation(self.tasks, self._glance)) is None:
            return last
        known = [time for time in (last, found.active) if time is not None and time >= self._glance.since]
        return max(known, default=None)

    def _unheard(self, state: State, what: str) -> str:
        """The reason where the instance hasn't sent what is waited for, such as the topic."""
        if state == "Starting":
            return f"waiting for the first {what}, for up to {duration(self._glance.grace)}"
        if state == "Failed" and self.tasks:
            return f"no {what}"
        if state == "Failed":
            return f"no {what} within {duration(self._glance.grace)} of the start"
        return f"{what} is silent"


class TopicLeaf(Leaf):
    """Holds while a topic is received often enough.

    - Gap: failed from the moment at which the last sample is that old.
    - Rate: failed while the count in a full window is outside the band.

    Before the first sample, and for a rate until the band has held for the first time, it is starting, for as long as
    the grace lasts; and in any case until a window has passed since the first sample.
    """

    def __init__(
        self,
        path: str,
        topic: str,
        glance: Glance,
        *,
        gap: float | None = None,
        window: Window | None = None,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """A leaf over a topic; ``gap`` in seconds. At least one of gap and window is given."""
        super().__init__(path, topic, glance, tasks)
        self.gap = gap
        self.window = window
        self._held: float | None = None
        """The instance (its ``since``) whose rate has been in the band once."""

    def state(self) -> State:
        """The state at the glance's moment."""
        if self.tasks:
            found = situation(self.tasks, self._glance)
            return self._task_state(found) if found is not None else "Healthy"
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
        """When it is no longer healthy; None where it isn't healthy."""
        if self.tasks:
            return self._task_healthy_until()
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
        record = self._record()
        moments = [self._glance.in_time]
        if self.tasks and (found := situation(self.tasks, self._glance)) is not None:
            moments += [found.settled]
            moments += [self._gap_limit(found, record)] if self.gap is not None else []
            moments += [self._judged_from(found, self.window)] if self.window is not None else []
        if record is not None and record.last is not None:
            if self.gap is not None:
                moments.append(record.last + self.gap)
            if self.window is not None:
                arrivals = self._arrivals(record)
                moments.append(self.window.leaves(arrivals[0]))
                moments.extend(self.window.changes(arrivals))
        return [moment for moment in moments if moment > self._glance.now]

    def last(self) -> float | None:
        """When all was last well: when the instance's last sample was received, or its task became active, in Unix seconds."""
        record = self._record()
        return self._last_with_task(record.last if record is not None else None)

    def _plain_reason(self, state: State) -> str:
        record = self._record()
        if record is None:
            return self._unheard(state, self.topic)
        if state == "Healthy":
            return f"{self.topic} is received"
        gap_failed = (
            self._task_gap_failed(record) if self.tasks else self.gap is not None and self._gap_state() == "Failed"
        )
        if self.gap is not None and gap_failed:
            return f"no {self.topic} for {duration(self.gap)}"
        assert self.window is not None, "a gap alone fails by the gap"
        if state == "Starting":
            return f"{self.topic} has not been at {self.window.band} for {duration(self.window.length)} yet"
        return self._rate_reason(self.window, self._arrivals(record))

    def _gap_state(self) -> State:
        record, glance = self._record(), self._glance
        if record is None or record.last is None:
            return "Starting" if glance.now < glance.in_time else "Failed"
        assert self.gap is not None
        return "Healthy" if glance.now < record.last + self.gap else "Failed"

    # -- for a task -------------------------------------------------------------------------------------------------

    def _task_state(self, found: Situation) -> State:
        glance, record = self._glance, self._record()
        in_grace = glance.now < glance.in_time
        failed: list[bool] = []
        if self.gap is not None:
            failed.append(glance.now >= self._gap_limit(found, record))
        if self.window is not None:
            arrivals = self._task_arrivals(found, record)
            unjudged = glance.now < self._judged_from(found, self.window)
            failed.append(not unjudged and not self.window.holds(arrivals, glance.now))
        if not any(failed):
            return "Healthy"
        # Grace is for an instance that hasn't been healthy yet.
        fresh = record is None or (self.window is not None and failed[-1] and self._held != glance.since)
        return "Starting" if in_grace and fresh else "Failed"

    def _task_healthy_until(self) -> float | None:
        found = situation(self.tasks, self._glance)
        if found is None:
            return math.inf
        if self._task_state(found) != "Healthy":
            return None
        record, until = self._record(), math.inf
        if self.gap is not None:
            until = self._gap_limit(found, record)
        if self.window is not None:
            arrivals, judged = self._task_arrivals(found, record), self._judged_from(found, self.window)
            if self._glance.now < judged and self.window.exceeded(arrivals, judged):
                return min(until, judged)
            until = min(until, max(judged, self.window.until(arrivals)))
        return until

    def _task_gap_failed(self, record: TopicRecord | None) -> bool:
        found = situation(self.tasks, self._glance)
        return found is not None and self.gap is not None and self._glance.now >= self._gap_limit(found, record)

    def _gap_limit(self, found: Situation, record: TopicRecord | None) -> float:
        """When a gap fails if nothing more arrives. An instance that took over an active task has the grace instead."""
        assert self.gap is not None
        last = record.last if record is not None and record.last is not None else -math.inf
        begun = found.active if found.active >= self._glance.since else -math.inf
        return max(found.settled, max(last, begun) + self.gap)

    def _judged_from(self, found: Situation, window: Window) -> float:
        """When a rate is judged first: a window after what it counts could have started."""
        return window.leaves(max(found.settled, found.active, self._glance.since))

    def _task_arrivals(self, found: Situation, record: TopicRecord | None) -> Sequence[float]:
        """The instance's arrivals since the task became active."""
        if record is None:
            return ()
        arrivals = list(record.arrivals)
        return arrivals[bisect_left(arrivals, max(found.active, self._glance.since)) :]

    def _rate_state(self, window: Window) -> State:
        record, glance = self._record(), self._glance
        in_grace = glance.now < glance.in_time
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
