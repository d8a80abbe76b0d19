"""What a policy made of what was seen, over time: when the tree failed, when that counted, and how each leaf was."""

from __future__ import annotations

from dataclasses import dataclass, field

from understudy.trees.core.debounce import Debounce
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import Observations
from understudy.trees.core.snapshots import Shown, shown


@dataclass
class Span:
    """A time in which a leaf, or the tree, was in one state. Times are Unix seconds."""

    state: Shown
    begun: float
    ended: float | None = None
    """None while it goes on."""
    reason: str = ""
    """As it was at the beginning; of failures and starts only."""


@dataclass
class Failure:
    """A time in which the tree was failed. Times are Unix seconds."""

    failed: float
    """When the tree failed."""
    leaf: str
    """Path of the leaf that decided it."""
    reason: str
    onset: float | None
    """When the last good sample was received, or all was last well otherwise; None where that can't be said."""
    detected: float | None = None
    """When it had been so for the policy's debounce, so that the monitor acts; None where it hadn't."""
    recovered: float | None = None
    """When the tree was no longer failed; None where it went on."""


@dataclass
class Course:
    """Judges by a policy's tree, just as the monitor does, and keeps what it said. Times are Unix seconds."""

    tree: HealthTree
    debounce: float
    """Seconds."""
    since: float
    """When the instance that is judged took control."""
    failures: list[Failure] = field(default_factory=list)
    """Times in which the tree was failed, whether that counted or not."""
    healthy: float | None = None
    """When the tree was healthy for the first time."""
    spans: dict[str, list[Span]] = field(default_factory=dict)
    """By path, the states of each leaf; under the empty path the tree's own."""

    def __post_init__(self) -> None:
        self._counting = Debounce()
        self._counts: float | None = None

    @property
    def detections(self) -> list[Failure]:
        """The failures that counted."""
        return [failure for failure in self.failures if failure.detected is not None]

    def look(self, observations: Observations, now: float) -> Verdict:
        """The verdict at a moment, which is noted."""
        verdict = self.tree.evaluate(observations, now=now, since=self.since)
        self._note("", verdict.state, now, verdict.reason)
        for leaf in self.tree.leaves:
            state = shown(leaf)
            self._note(leaf.name, state, now, leaf.feedback_message if state in ("Failed", "Starting") else "")
        if verdict.state == "Failed":
            self._fail(verdict, now)
        else:
            self._counting.clear()
            self._counts = None
            if self.failures and self.failures[-1].recovered is None:
                self.failures[-1].recovered = now
            if verdict.state == "Healthy" and self.healthy is None:
                self.healthy = now
        return verdict

    def _fail(self, verdict: Verdict, now: float) -> None:
        counts = self._counting.failed(now, self.debounce)
        if not self.failures or self.failures[-1].recovered is not None:
            self.failures.append(Failure(now, verdict.leaf, verdict.reason, verdict.onset))
        last = self.failures[-1]
        if last.detected is not None:
            return
        # The last verdict before it counts is what the monitor acts on.
        last.leaf, last.reason, last.onset = verdict.leaf, verdict.reason, verdict.onset
        self._counts = counts
        if now >= counts:
            last.detected, self._counts = now, None

    def next_look(self, observations: Observations, now: float) -> float | None:
        """The next moment at which something may be another with nothing more received; None for never."""
        change = self.tree.next_change(observations, now=now, since=self.since)
        moments = [moment for moment in (change, self._counts) if moment is not None]
        return min(moments, default=None)

    def end(self, now: float) -> None:
        """Nothing more is judged."""
        for spans in self.spans.values():
            spans[-1].ended = now

    def _note(self, path: str, state: Shown, now: float, reason: str) -> None:
        spans = self.spans.setdefault(path, [])
        if spans and spans[-1].state == state:
            return
        if spans:
            spans[-1].ended = now
        spans.append(Span(state, now, reason=reason if state != "Healthy" else ""))
