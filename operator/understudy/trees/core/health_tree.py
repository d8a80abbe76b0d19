"""A health tree: its verdict now, and the exact time at which the verdict gets worse if nothing more arrives.

Detection does not depend on the tick rate. After each evaluation, call :meth:`HealthTree.deadline` and wake up then: a
500 ms gap is detected 500 ms after the last message was received, however slow the ticks are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Parallel, Sequence
from py_trees.decorators import Inverter

from understudy.trees.core.composites import AnyOf
from understudy.trees.core.leaf import STATE, Leaf, State
from understudy.trees.core.observations import Evaluation, Observations
from understudy.trees.core.task_activity import While

Build = Callable[[Collection[str]], Behaviour | None]
"""Builds the behaviours of a node without the leaves of some topics; None if nothing is left."""

SEVERITY: dict[State, int] = {"Healthy": 0, "Starting": 1, "Failed": 2}
"""Rank of a state; a verdict gets worse if it grows."""


@dataclass(frozen=True)
class WatchedTopic:
    """A topic that a tree needs, and what it needs of the topic."""

    name: str
    type: str | None
    """``package/msg/Name``; None if the tree takes it from the ROS graph."""
    window: float
    """Seconds of arrivals that are evaluated; 0 if only the last one is."""
    rate: float | None
    """Expected messages per second; None if the tree does not say."""
    task: bool = False
    """Whether it is the status of an action, for which the tree needs to know whether a goal is active."""
    contents: int = 0
    """How many of the last messages have their contents evaluated."""
    whole: bool = False
    """Whether more than the header at the start of these messages is evaluated."""
    subscribed: bool = True
    """Whether its messages are received at all."""
    publishers: bool = False
    """Whether the tree needs to know who publishes it."""
    managed: bool = False
    """Whether it is the topic on which a managed node reports its transitions, and the tree needs the node's state."""
    node: bool = False
    """Whether it stands for a node, and the tree needs to know whether there is a node of this name."""
    prompt: bool = False
    """Whether a message can be a failure when it arrives, so that the tree must be evaluated then. A silence, or a
    condition that must not hold for a while, is computed in advance."""
    parameters: frozenset[tuple[str, str]] = frozenset()
    """The parameters whose values the tree needs and whose changes are reported there, each with the name of its node
    and its own."""
    pod: bool = False
    """Whether it is not a topic, but stands for the pod of the active instance."""
    usage: bool = False
    """Whether the tree needs the CPU and memory usage of that pod."""

    @property
    def reliable(self) -> bool:
        """Whether no message may be lost."""
        return self.managed or bool(self.parameters)

    def joined(self, other: WatchedTopic) -> WatchedTopic:
        """Return a need that covers this one and another one of the same topic."""
        rates = [rate for rate in (self.rate, other.rate) if rate is not None]
        return replace(
            self,
            type=self.type or other.type,
            window=max(self.window, other.window),
            rate=max(rates, default=None),
            contents=max(self.contents, other.contents),
            task=self.task or other.task,
            whole=self.whole or other.whole,
            subscribed=self.subscribed or other.subscribed,
            publishers=self.publishers or other.publishers,
            managed=self.managed or other.managed,
            node=self.node or other.node,
            prompt=self.prompt or other.prompt,
            parameters=self.parameters | other.parameters,
            pod=self.pod or other.pod,
            usage=self.usage or other.usage,
        )


@dataclass(frozen=True)
class Verdict:
    """The tree's verdict on an instance."""

    state: State
    """Starting, Healthy or Failed."""
    reason: str
    """Why, in plain words with figures; empty while healthy. The figure of a failing rate differs between verdicts."""
    leaf: str
    """Path of the leaf that caused it, such as ``sensors/scan``; empty while healthy."""
    onset: float | None
    """Of a failure: when the last good sample was received (Unix seconds); None if there never was one."""


_HEALTHY = Verdict("Healthy", "", "", None)


class HealthTree:
    """The definition of a healthy instance, as py_trees behaviours.

    A tree judges one instance at a time: for the current ``since``, it remembers which rates have held once. All times
    are Unix seconds.
    """

    def __init__(self, build: Build, evaluation: Evaluation, topics: list[WatchedTopic]) -> None:
        """``build`` makes the behaviours; ``topics`` are all topics that they evaluate."""
        self.topics = topics
        """The topics to subscribe to, each once."""
        self._build = build
        self._evaluation = evaluation
        self._left_out: frozenset[str] | None = None
        self._forecast: tuple[Observations, float, float, dict[str, float]] | None = None
        """Result of the last evaluation if all leaves were healthy: observations, time, since when, and by leaf path
        the end of health."""
        self._failing: frozenset[str] = frozenset()
        self.root: Behaviour | None = None
        """The behaviours with the states of the last evaluation; None if nothing can be judged."""
        self.leave_out(())

    def begin(self, now: float) -> None:
        """Start to judge by this tree at ``now`` (Unix seconds). Topics that it newly names have the grace to
        arrive, although the instance is not new."""
        self._evaluation.in_use_since = now
        self._forecast = None

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        """Judge the instance in control since ``since`` as one that had been healthy before this tree was in use, and
        that can be heard from ``heard_from`` on: topics have less time for their first message."""
        self._evaluation.expected_since, self._evaluation.heard_from = since, heard_from
        self._forecast = None

    def leave_out(self, topics: Collection[str]) -> None:
        """Judge without the leaves of these topics, because they cannot be watched: a topic that cannot be watched is
        not a failure.

        A leaf's own path, such as ``sensors/scan``, excludes only that leaf. Composites are judged by their remaining
        children. Cheap if nothing changed.
        """
        if topics == self._left_out:
            return
        self._left_out = frozenset(topics)
        self._forecast = None
        self.root = self._build(self._left_out)
        nodes = list(self.root.iterate()) if self.root is not None else []
        self._leaves = [node for node in nodes if isinstance(node, Leaf)]
        # Nearly always, all leaves are healthy. If the tree is healthy then, no node needs a tick.
        self._well = {node for node in nodes if _well(node)}

    @property
    def judged(self) -> list[WatchedTopic]:
        """The topics that are not left out."""
        return [topic for topic in self.topics if topic.name not in (self._left_out or ())]

    def counting(self, observations: Observations, *, now: float, since: float) -> set[str]:
        """Return the topics whose messages count now: all that are judged, except those that are only for a task that
        is not active."""
        self._set_evaluation(observations, now, since, real=False)
        return {leaf.topic for leaf in self._leaves if leaf.uses_messages and leaf.counts()}

    @property
    def leaves(self) -> list[Leaf]:
        """The leaves that are judged, with their states at the last evaluation."""
        return list(self._leaves)

    @property
    def failing(self) -> frozenset[str]:
        """The topics whose messages, or their absence, made the tree fail at its last evaluation; empty if it did not fail."""
        return self._failing

    @property
    def blind(self) -> list[str]:
        """Return in words why some judged leaves cannot judge."""
        return [leaf.blind for leaf in self._leaves if leaf.blind]

    def evaluate(self, observations: Observations, *, now: float, since: float) -> Verdict:
        """Return the verdict at ``now`` on the instance that has been in control since ``since`` (or was first seen
        then).

        Read the topics first, then take ``now``: a message that has arrived but was not noted counts as missing.
        """
        self._failing = frozenset()
        if self.root is None:
            return Verdict(
                "Starting", f"none of {', '.join(topic.name for topic in self.topics)} can be watched", "", None
            )
        self._forecast = None
        shown = all(leaf.status == Status.SUCCESS for leaf in self._leaves)
        if shown and (until := self._healthy_until(observations, now, since)) is not None:
            for leaf in self._leaves:
                leaf.remember()
            self._forecast = observations, now, since, until
            return _HEALTHY
        state = self._tick(observations, now, since)
        if state == "Healthy":
            return _HEALTHY
        leaves = _decisive(self.root)
        onset = _onset(self.root) if state == "Failed" else None
        if state == "Failed":
            self._failing = frozenset(leaf.topic for leaf, _ in leaves if leaf.uses_messages)
        return Verdict(state, "; ".join(reason for _, reason in leaves), leaves[0][0].name, onset)

    def deadline(self, observations: Observations, *, now: float, since: float) -> float | None:
        """Return the first time at which :meth:`evaluate` would be worse than now if nothing more arrives; None for
        never. With an inverter in the tree it may be earlier, but still later than now.

        It is valid until the next message or evaluation. A call after an evaluation with the same times, and before
        anything more is noted, costs almost nothing while all leaves are healthy.
        """
        if self.root is None:
            return None
        forecast, self._forecast = self._forecast, None
        if forecast is not None and forecast[0] is observations and forecast[1:3] == (now, since):
            until: dict[str, float] | None = forecast[3]
        else:
            until = self._healthy_until(observations, now, since)
        if until is not None:
            moment = _first_loss(self.root, until, self._well)
            return moment if math.isfinite(moment) else None
        present = SEVERITY[self._tick(observations, now, since)]
        if present == SEVERITY["Failed"]:
            return None
        found = None
        for moment in sorted({moment for leaf in self._leaves for moment in leaf.changes()}):
            if SEVERITY[self._tick(observations, moment, since, real=False)] > present:
                found = moment
                break
        self._tick(observations, now, since)  # so that the nodes show the present state, not the one that was tried
        return found

    def next_change(self, observations: Observations, *, now: float, since: float) -> float | None:
        """Return the first time after ``now`` at which any leaf may change if nothing more arrives; None for never.

        Unlike :meth:`deadline`, it also works while the tree is failed, and includes times at which the state may
        improve.
        """
        self._set_evaluation(observations, now, since, real=False)
        return min((moment for leaf in self._leaves for moment in leaf.changes()), default=None)

    def _healthy_until(self, observations: Observations, now: float, since: float) -> dict[str, float] | None:
        """Return by path when each leaf stops being healthy; None unless all of them, and therefore the tree, are
        healthy."""
        if self.root not in self._well:
            return None
        self._set_evaluation(observations, now, since, real=True)
        found = {}
        for leaf in self._leaves:
            until = leaf.healthy_until()
            if until is None:
                return None
            found[leaf.name] = until
        return found

    def _set_evaluation(self, observations: Observations, now: float, since: float, *, real: bool) -> None:
        evaluation = self._evaluation
        evaluation.observations, evaluation.now, evaluation.since, evaluation.real = observations, now, since, real
        if real and evaluation.in_use_since > now:  # the clock was set back meanwhile
            evaluation.in_use_since = now

    def _tick(self, observations: Observations, now: float, since: float, *, real: bool = True) -> State:
        self._set_evaluation(observations, now, since, real=real)
        assert self.root is not None, "there is something to judge"
        for _ in self.root.tick():
            pass
        return STATE[self.root.status]


def _well(node: Behaviour) -> bool:
    """Return whether a node is healthy while all its leaves are."""
    if isinstance(node, Leaf):
        return True
    if isinstance(node, Inverter):
        return not _well(node.decorated)
    children = [_well(child) for child in node.children]
    return any(children) if isinstance(node, AnyOf) else all(children)


def _first_loss(node: Behaviour, until: dict[str, float], well: Collection[Behaviour]) -> float:
    """Return when a node that is healthy over healthy leaves stops being so: alternatives with their last child, other nodes with
    their first, and an inverter not before one of its leaves. ``well`` are all such nodes."""
    if isinstance(node, Leaf):
        return until[node.name]
    if isinstance(node, Inverter):
        return min(until[leaf.name] for leaf in node.iterate() if isinstance(leaf, Leaf))
    losses = [_first_loss(child, until, well) for child in node.children if child in well]
    return max(losses) if isinstance(node, AnyOf) else min(losses)


def _decisive(node: Behaviour, *, inverted: bool = False) -> list[tuple[Leaf, str]]:
    """Return the leaves that gave a node its status, with their reasons, in the tree's order."""
    if isinstance(node, Leaf):
        reason = node.reason(STATE[node.status])
        return [
            (
                node,
                f"{reason}, but the tree requires the opposite"
                if inverted and node.status != Status.RUNNING
                else reason,
            )
        ]
    if isinstance(node, While) and not node.counts():
        # Its child counts as healthy while the task is not active, so this matters only under an inverter.
        leaf = next(inner for inner in node.iterate() if isinstance(inner, Leaf))
        return [(leaf, f"no goal of {node.task.action} is active, but the tree requires the opposite")]
    if isinstance(node, Inverter):
        return _decisive(node.decorated, inverted=not inverted)
    return [found for child in _deciding(node) for found in _decisive(child, inverted=inverted)]


def _deciding(node: Behaviour) -> list[Behaviour]:
    return [child for child in node.children if child.status == node.status]


def _onset(node: Behaviour) -> float | None:
    """Return when a failed node was last seen to be good."""
    if isinstance(node, Leaf):
        return node.last()
    if isinstance(node, While):
        return _onset(node.decorated)
    if not isinstance(node, Parallel | Sequence | AnyOf):
        return None  # An inverter fails because of a message, and no message marks its last good moment.
    onsets = [onset for child in _deciding(node) if (onset := _onset(child)) is not None]
    if not onsets:
        return None
    # A conjunction was good until the first child was lost, an alternative until the last one was.
    return max(onsets) if isinstance(node, AnyOf) else min(onsets)
