"""The leaf ``topic``: whether messages of a topic are received often enough."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence

from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import Leaf, LeafPlace, State, duration
from understudy.trees.core.observations import TopicRecord
from understudy.trees.core.rate_window import Band, Window, hertz
from understudy.trees.core.task_activity import TaskTiming, task_timing
from understudy.trees.leaves.leaf_plan import TYPE, Key, LeafKind, LeafPlan, LeafValues, time_key, topic_key
from understudy.trees.source.value_reader import found_text


class TopicLeaf(Leaf):
    """Holds while a topic is received often enough.

    - Gap: failed from the time at which the last sample is that old, and the observer has not been stalled for as long.
    - Rate: failed while the count in a full window is outside the band.

    Before the first sample, and for a rate until the band has held for the first time, the leaf is starting until the
    grace ends. A rate is always starting until a window has passed since the first sample. After a stall of the
    observer, which loses samples, a rate is judged again when a window has passed: until then it counts as before.
    """

    def __init__(self, place: LeafPlace, topic: str, gap: float | None, window: Window | None) -> None:
        """Make a leaf over a topic; ``gap`` in seconds. At least one of gap and window is given."""
        super().__init__(place, topic)
        self.gap = gap
        self.window = window
        self._held: float | None = None
        """The instance (its ``since``) whose rate has been in the band once."""

    def state(self) -> State:
        """Return the state at the time of the evaluation."""
        if self.tasks:
            found = task_timing(self.tasks, self._evaluation)
            return self._task_state(found) if found is not None else "Healthy"
        states = [self._gap_state()] if self.gap is not None else []
        if self.window is not None:
            states.append(self._rate_state(self.window))
        if "Failed" in states:
            return "Failed"
        return "Starting" if "Starting" in states else "Healthy"

    @property
    def _first_by(self) -> float:
        """Until when the topic may be healthy for the first time, in Unix seconds."""
        return self._evaluation.first_by(max(self.gap or 0.0, self.window.length if self.window is not None else 0.0))

    def remember(self) -> None:
        """Note that the instance has been healthy by this leaf: its rate then has no more grace."""
        self._held = self._evaluation.since

    def healthy_until(self) -> float | None:
        """Return when the leaf stops being healthy; None if it is not healthy."""
        if self.tasks:
            return self._task_healthy_until()
        record, now, since = (
            self._evaluation.observations.topic(self.topic),
            self._evaluation.now,
            self._evaluation.since,
        )
        if record is None or record.last is None or record.last < since:
            return None
        until = self._gap_end(record) if self.gap is not None else math.inf
        if self.window is not None:
            arrivals = self._arrivals(record)
            if self._rate_state(self.window) != "Healthy":
                return None
            judged = self.window.leaves(record.observed_since)
            exceeds = now < judged and self.window.exceeded(arrivals, judged)
            until = min(until, judged if exceeds else max(judged, self.window.until(arrivals)))
        return until if now < until else None

    def changes(self) -> list[float]:
        """Return the times after the evaluation at which the state may change without a further message."""
        record = self._record()
        moments = [self._first_by]
        if self.tasks and (found := task_timing(self.tasks, self._evaluation)) is not None:
            moments += [found.settled]
            moments += [self._gap_limit(found, record)] if self.gap is not None else []
            moments += [self._judged_from(found, record, self.window)] if self.window is not None else []
        if record is not None and record.last is not None:
            if self.gap is not None:
                moments.append(self._gap_end(record))
            if self.window is not None:
                arrivals = self._arrivals(record)
                moments += [self.window.leaves(arrivals[0]), self.window.leaves(record.observed_since)]
                moments.extend(self.window.changes(arrivals))
        return [moment for moment in moments if moment > self._evaluation.now]

    def last(self) -> float | None:
        """Return the last good time, in Unix seconds: when the instance's last sample was received, or the task became
        active."""
        record = self._record()
        return self._last_with_task(record.last if record is not None else None)

    def _plain_reason(self, state: State) -> str:
        record = self._record()
        if record is None:
            return self._nothing_received(state, self.topic, self._first_by - self._evaluation.began)
        if state == "Healthy":
            return f"{self.topic} is received"
        gap_failed = (
            self._task_gap_failed(record) if self.tasks else self.gap is not None and self._gap_state() == "Failed"
        )
        if self.gap is not None and gap_failed:
            return f"no {self.topic} for {duration(self.gap)}"
        assert self.window is not None, "a gap alone fails by the gap"
        if state == "Starting":
            return f"{self.topic} has not had a rate of {self.window.band} for {duration(self.window.length)} yet"
        return self._rate_reason(self.window, self._arrivals(record))

    def _gap_state(self) -> State:
        record, evaluation = self._record(), self._evaluation
        if record is None or record.last is None:
            return "Starting" if evaluation.now < self._first_by else "Failed"
        return "Healthy" if evaluation.now < self._gap_end(record) else "Failed"

    def _gap_end(self, record: TopicRecord | None) -> float:
        """Return when a gap fails if nothing more arrives. A stall of the observer may have lost samples, so the gap begins after it."""
        assert self.gap is not None
        if record is None or record.last is None:
            return -math.inf
        return max(record.last, record.observed_since) + self.gap

    # -- for a task -------------------------------------------------------------------------------------------------

    def _task_state(self, found: TaskTiming) -> State:
        evaluation, record = self._evaluation, self._record()
        in_grace = evaluation.now < self._first_by
        failed: list[bool] = []
        if self.gap is not None:
            failed.append(evaluation.now >= self._gap_limit(found, record))
        if self.window is not None:
            arrivals = self._task_arrivals(found, record)
            unjudged = evaluation.now < self._judged_from(found, record, self.window)
            failed.append(not unjudged and not self.window.holds(arrivals, evaluation.now))
        if not any(failed):
            return "Healthy"
        # Grace applies only to an instance that has not been healthy yet.
        fresh = record is None or (self.window is not None and failed[-1] and self._held != evaluation.since)
        return "Starting" if in_grace and fresh else "Failed"

    def _task_healthy_until(self) -> float | None:
        found = task_timing(self.tasks, self._evaluation)
        if found is None:
            return math.inf
        if self._task_state(found) != "Healthy":
            return None
        record, until = self._record(), math.inf
        if self.gap is not None:
            until = self._gap_limit(found, record)
        if self.window is not None:
            arrivals, judged = self._task_arrivals(found, record), self._judged_from(found, record, self.window)
            if self._evaluation.now < judged and self.window.exceeded(arrivals, judged):
                return min(until, judged)
            until = min(until, max(judged, self.window.until(arrivals)))
        return until

    def _task_gap_failed(self, record: TopicRecord | None) -> bool:
        found = task_timing(self.tasks, self._evaluation)
        return found is not None and self.gap is not None and self._evaluation.now >= self._gap_limit(found, record)

    def _gap_limit(self, found: TaskTiming, record: TopicRecord | None) -> float:
        """Return when a gap fails if nothing more arrives. An instance that took over an active task has the grace
        instead."""
        assert self.gap is not None
        active_since = found.active if found.active >= self._evaluation.since else -math.inf
        return max(found.settled, active_since + self.gap, self._gap_end(record))

    def _judged_from(self, found: TaskTiming, record: TopicRecord | None, window: Window) -> float:
        """Return when a rate is judged for the first time: one window after the messages that it counts could have
        started, or after the observer was stalled."""
        observed = record.observed_since if record is not None else -math.inf
        return window.leaves(max(found.settled, found.active, self._evaluation.since, observed))

    def _task_arrivals(self, found: TaskTiming, record: TopicRecord | None) -> Sequence[float]:
        """Return the instance's arrivals since the task became active."""
        if record is None:
            return ()
        arrivals = list(record.arrivals)
        return arrivals[bisect_left(arrivals, max(found.active, self._evaluation.since)) :]

    def _rate_state(self, window: Window) -> State:
        record, evaluation = self._record(), self._evaluation
        in_grace = evaluation.now < self._first_by
        if record is None:
            if in_grace:
                return "Starting"
            return "Failed" if window.least else "Healthy"
        arrivals = self._arrivals(record)
        if evaluation.now < window.leaves(arrivals[0]):
            return "Starting"
        if evaluation.now < window.leaves(record.observed_since):
            return "Healthy" if self._held == evaluation.since else "Starting"
        if window.holds(arrivals, evaluation.now):
            return "Healthy"
        return "Starting" if in_grace and self._held != evaluation.since else "Failed"

    def _rate_reason(self, window: Window, arrivals: Sequence[float]) -> str:
        now, band = self._evaluation.now, window.band
        exceeded = window.exceeded(arrivals, now)
        rate, bound = window.rate(arrivals, now), (band.high if exceeded else band.low) or 0
        where = "above" if exceeded else "below"
        if rate == bound:  # A strict bound that is just met: "below 8 Hz" would be wrong for 8 Hz.
            where = "not below" if exceeded else "not above"
        return f"{self.topic} at {hertz(rate)}, {where} {hertz(bound)} over {duration(window.length)}"

    def _record(self) -> TopicRecord | None:
        """Return the topic's record; None without a sample of this instance."""
        record = self._evaluation.observations.topic(self.topic)
        if record is None or record.last is None or record.last < self._evaluation.since:
            return None
        return record

    def _arrivals(self, record: TopicRecord) -> Sequence[float]:
        """Return the instance's arrivals, at least one."""
        arrivals = record.arrivals
        if arrivals[0] >= self._evaluation.since:
            return arrivals
        return list(arrivals)[bisect_left(arrivals, self._evaluation.since) :]


# -- how it is written ------------------------------------------------------------------------------------------------


def _check(values: LeafValues) -> None:
    if "gap" not in values and "rate" not in values:
        values.problem("", "neither gap nor rate is given; give gap, such as 500ms, or rate, such as '> 8 Hz'")
    if "window" in values and "rate" not in values:
        values.problem("window", "a window is only for a rate; give rate, or remove window")
    band, length = values["rate"], values["window"]
    if band is not None and length is not None and length < band.shortest_window():
        values.problem(
            "window",
            f"{duration(length)} is too short to tell whether a rate is {band}: a window counts whole messages; "
            f"give at least {duration(band.shortest_window())}",
        )


def _plan(values: LeafValues) -> LeafPlan:
    topic, gap, band = values["name"], values["gap"], values["rate"]
    window = Window(band, values["window"] or band.default_window()) if band is not None else None
    return LeafPlan(
        topic.lstrip("/"),
        WatchedTopic(topic, values["type"], window.length if window else 0.0, window.band.expected if window else None),
        lambda place: TopicLeaf(place, topic, gap, window),
    )


def _band(value: object) -> Band:
    if not isinstance(value, str):
        raise ValueError(f"found {found_text(value)}; write '> 8 Hz', '>= 8 Hz', '< 20 Hz', '<= 20 Hz' or '9 to 11 Hz'")
    return Band.parse(value)


TOPIC = LeafKind(
    "topic",
    "while the topic is received often enough",
    (
        topic_key("/cmd_vel", name="name", xml="topic"),
        TYPE,
        time_key("gap", "the longest silence, such as 500ms"),
        Key("rate", "a band, such as > 8 Hz or 9 to 11 Hz", "frequency", read=_band),
        time_key("window", "the time over which a rate is counted, such as 2s"),
    ),
    "{name: /cmd_vel, gap: 500ms}",
    _plan,
    _check,
)
