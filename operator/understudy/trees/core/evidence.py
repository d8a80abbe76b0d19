"""Leaves that judge a stream of evidence, and record since when their condition holds or does not hold."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from understudy.trees.core.leaf import Leaf, LeafPlace, State, duration
from understudy.trees.core.observations import Answer, Evidence
from understudy.trees.core.task_activity import task_timing

EvidenceT = TypeVar("EvidenceT", bound=Evidence)
AnswerT = TypeVar("AnswerT", bound=Answer)


class Finding(NamedTuple):
    """What one piece of evidence, such as a message, says about the condition of a leaf."""

    holds: bool
    """False also if the condition cannot be determined: a required condition must be seen to hold."""
    why: str
    """The subject and the value that does not meet the condition, such as ``/battery: percentage was 0.1``; empty if
    the condition holds."""
    starting: bool = False
    """Whether the only reason is something that is still starting, for which the condition has never held."""


@dataclass
class EvidenceTrack(Generic[EvidenceT]):
    """The evidence about one instance so far. Times are Unix seconds."""

    since: float = math.nan
    """When the instance took control, which identifies it."""
    last_evaluated: EvidenceT | None = None
    """The newest message that was evaluated."""
    received: float = 0.0
    """When that message was received, by the clock at that time."""
    held: bool = False
    """Whether the condition has ever held."""
    last_finding: float | None = None
    """When the last message with a finding was received."""
    good: float | None = None
    """When the last message that met the condition was received."""
    bad: float | None = None
    """When the first message was received with which the condition stopped holding; None while it holds."""
    why: str = ""
    """Why it does not hold, according to that message. The text stays the same while the failure lasts."""

    def note(self, finding: Finding, content: EvidenceT) -> None:
        """Note the result of a message."""
        self.last_finding = content.received
        if finding.holds:
            self.held, self.good, self.bad, self.why = True, content.received, None, ""
            return
        if finding.starting:
            self.held = False
        if self.bad is None:
            self.bad, self.why = content.received, finding.why

    def shift(self) -> None:
        """Follow a step of the clock, which moved the time of the newest message."""
        if self.last_evaluated is None or self.last_evaluated.received == self.received:
            return
        step = self.last_evaluated.received - self.received
        self.received = self.last_evaluated.received
        self.last_finding = self.last_finding + step if self.last_finding is not None else None
        self.good = self.good + step if self.good is not None else None
        self.bad = self.bad + step if self.bad is not None else None


class EvidenceLeaf(Leaf, Generic[EvidenceT]):
    """Holds while the evidence confirms its condition; fails after ``hold_off`` seconds of evidence against it.

    The time of the failure is exact, whether or not more evidence arrives before. Before the first evidence, and until
    the condition has held for the first time, the leaf is starting until the grace ends.
    """

    def __init__(self, place: LeafPlace, topic: str, hold_off: float = 0.0) -> None:
        super().__init__(place, topic)
        self.hold_off = hold_off
        self._track: EvidenceTrack[EvidenceT] = EvidenceTrack()

    def newest(self) -> EvidenceT | None:
        """Return the last observation, for a leaf that evaluates only that; None if there is none."""
        return None

    def fresh(self, track: EvidenceTrack[EvidenceT]) -> list[EvidenceT]:
        """Return the instance's evidence that has not been evaluated, oldest first: the last observation, once."""
        found = self.newest()
        if found is None or found is track.last_evaluated or found.received < self._evaluation.since:
            return []
        return [found]

    @abstractmethod
    def evaluate(self, content: EvidenceT, failed: bool) -> Finding | None:
        """Evaluate one piece of evidence; None if it says nothing about the condition. ``failed`` is whether the
        condition did not hold before."""

    @abstractmethod
    def condition(self) -> str:
        """Return the condition in words, such as ``percentage > 0.15 of /battery_state``."""

    def requirement(self) -> str:
        """Return what the condition requires, in words that follow a finding, such as ``percentage > 0.15 is required``."""
        return f"{self.condition()} is required"

    def awaited(self) -> str:
        """Return what must arrive first, in words."""
        return self.topic

    def forget(self) -> None:
        """Forget the messages of another instance."""

    # -- evidence ---------------------------------------------------------------------------------------------------

    def followed(self) -> EvidenceTrack[EvidenceT]:
        """Return the evidence up to the time of the evaluation. Each message is evaluated once."""
        evaluation, track = self._evaluation, self._track
        if track.since != evaluation.since:
            track = self._track = EvidenceTrack(evaluation.since)
            self.forget()
        track.shift()
        for content in self.fresh(track):
            failed = track.held and track.bad is not None and content.received >= track.bad + self.hold_off
            if (finding := self.evaluate(content, failed)) is not None:
                track.note(finding, content)
            track.last_evaluated, track.received = content, content.received
        return track

    # -- the state --------------------------------------------------------------------------------------------------

    def lost(self, track: EvidenceTrack[EvidenceT]) -> float:
        """Return when the leaf fails if nothing more arrives, in Unix seconds; infinite for never."""
        return max(track.bad, self.clocks_start()) + self.hold_off if track.bad is not None else math.inf

    def clocks_start(self) -> float:
        """Return the earliest start of the leaf's clocks: the start of its task, if the instance was in control by
        then."""
        found = task_timing(self.tasks, self._evaluation) if self.tasks else None
        return found.active if found is not None and found.active >= self._evaluation.since else -math.inf

    def _limits(self, track: EvidenceTrack[EvidenceT]) -> tuple[float, float]:
        """Return when the leaf stops being healthy, and when it fails, if nothing more arrives; in between it is
        starting."""
        evaluation = self._evaluation
        if not self.tasks:
            if not track.held:
                return -math.inf, evaluation.in_time
            healthy = self.lost(track)
            return healthy, healthy
        found = task_timing(self.tasks, evaluation)
        if found is None:
            return math.inf, math.inf
        lost = self.lost(track)
        healthy = max(found.settled, lost) if track.held or lost < math.inf else found.settled
        # Grace applies only to an instance for which the condition has not held yet.
        return healthy, healthy if track.held else max(healthy, evaluation.in_time)

    def state(self) -> State:
        """Return the state at the time of the evaluation."""
        healthy, fails = self._limits(self.followed())
        if self._evaluation.now < healthy:
            return "Healthy"
        return "Starting" if self._evaluation.now < fails else "Failed"

    def healthy_until(self) -> float | None:
        """Return when the leaf stops being healthy; None if it is not healthy."""
        healthy, _ = self._limits(self.followed())
        return healthy if self._evaluation.now < healthy else None

    def changes(self) -> list[float]:
        """Return the times after the evaluation at which the state may change without a further message."""
        return [m for m in self._limits(self.followed()) if self._evaluation.now < m < math.inf]

    def last(self) -> float | None:
        """Return the last good time: when a message that met the condition was received, or the task became active."""
        return self._last_with_task(self.followed().good)

    def _plain_reason(self, state: State) -> str:
        track, condition = self.followed(), self.condition()
        if track.good is None and track.bad is None:
            return self._nothing_received(state, self.awaited())
        if state == "Healthy":
            return f"{condition} holds" if track.held else f"{condition} is not required yet"
        found = f"{track.why}, but {self.requirement()}"
        if state == "Starting":
            return f"{found} (not met yet)"
        if not track.held and not self.tasks:
            return f"{found} (not met within {duration(self._evaluation.grace)} of the start)"
        return f"{found} (violated for {duration(self.hold_off)})" if self.hold_off else found


class AnswerLeaf(EvidenceLeaf[AnswerT]):
    """Judges what a node reports about itself. Holds while the report cannot be determined, because that is no failure."""

    uses_messages = False

    @abstractmethod
    def wrong(self, content: AnswerT) -> str:
        """Return the subject and the value that is not as expected, in words; empty if it is as expected."""

    def evaluate(self, content: AnswerT, failed: bool) -> Finding | None:
        """Evaluate an answer."""
        if not content.is_known:
            return None
        why = self.wrong(content)
        if why and self._track.bad is not None:
            self._track.why = why  # if the answers change, the latest one is the most useful
        return Finding(not why, why)

    def _limits(self, track: EvidenceTrack[AnswerT]) -> tuple[float, float]:
        found = self.newest()
        if found is not None and found.received >= self._evaluation.since and not found.is_known:
            return math.inf, math.inf
        return super()._limits(track)
