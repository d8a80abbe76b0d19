"""Records the evaluation of a tree over time: failures, detections, and the state of each leaf."""

from __future__ import annotations

from dataclasses import dataclass, field

from understudy.trees.core.debounce import Debounce
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import Observations
from understudy.trees.core.snapshots import Shown, shown


@dataclass
class Span:
    """An interval in which a leaf, or the tree, was in one state. Times are unix seconds."""

    state: Shown
    started: float
    ended: float | None = None
    """None while it continues."""
    reason: str = ""
    """The reason at the start; only for failures and starts."""


@dataclass
class Failure:
    """An interval in which the tree was failed. Times are unix seconds."""

    failed: float
    """When the tree failed."""
    leaf: str
    """Path of the leaf that caused it."""
    reason: str
    onset: float | None
    """The time of the last good sample, or of the last healthy state; None if unknown."""
    detected: float | None = None
    """When it had lasted for the policy's debounce, so that the monitor acts; None if it did not."""
    recovered: float | None = None
    """When the tree was no longer failed; None if it continued."""


@dataclass
class Evaluation:
    """Evaluates a policy's tree as the monitor does, and records the results. Times are unix seconds."""

    tree: HealthTree
    debounce: float
    """Seconds."""
    since: float
    """When the evaluated instance took control."""
    failures: list[Failure] = field(default_factory=list)
    """Intervals in which the tree was failed, whether detected or not."""
    healthy: float | None = None
    """When the tree was healthy for the first time."""
    spans: dict[str, list[Span]] = field(default_factory=dict)
    """By path, the states of each leaf; the empty path is the tree."""

    def __post_init__(self) -> None:
        self._counting = Debounce()
        self._counts: float | None = None

    @property
    def detections(self) -> list[Failure]:
        """The failures that were detected."""
        return [failure for failure in self.failures if failure.detected is not None]

    def evaluate(self, observations: Observations, now: float) -> Verdict:
        """Evaluate the tree at a time and record the verdict."""
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
        # The monitor acts on the last verdict before the detection.
        last.leaf, last.reason, last.onset = verdict.leaf, verdict.reason, verdict.onset
        self._counts = counts
        if now >= counts:
            last.detected, self._counts = now, None

    def next_evaluation(self, observations: Observations, now: float) -> float | None:
        """Return the next time at which the result may change without a further message; None for never."""
        change = self.tree.next_change(observations, now=now, since=self.since)
        moments = [moment for moment in (change, self._counts) if moment is not None]
        return min(moments, default=None)

    def end(self, now: float) -> None:
        """End the evaluation."""
        for spans in self.spans.values():
            spans[-1].ended = now

    def _note(self, path: str, state: Shown, now: float, reason: str) -> None:
        spans = self.spans.setdefault(path, [])
        if spans and spans[-1].state == state:
            return
        if spans:
            spans[-1].ended = now
        spans.append(Span(state, now, reason=reason if state != "Healthy" else ""))
