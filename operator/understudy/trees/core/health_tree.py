"""A health tree: its verdict now, and the exact time at which that gets worse if nothing more arrives.

Detection is not bound to a tick. After each evaluation, ask :meth:`HealthTree.deadline` and wake up then: a
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
"""How bad a state is; a verdict gets worse when this grows."""


@dataclass(frozen=True)
class WatchedTopic:
    """A topic that a tree needs, with what is needed of it."""

    name: str
    type: str | None
    """``package/msg/Name``; None if the tree leaves it to the ROS graph."""
    window: float
    """Seconds of arrivals that are looked at; 0 if only the last one is."""
    rate: float | None
    """Messages per second to be ready for; None if the tree does not say."""
    task: bool = False
    """Whether it is the status of an action, of which it matters whether a goal is active."""
    contents: int = 0
    """How many of the last messages are looked into."""
    whole: bool = False
    """Whether more of them is looked at than the header at their start."""
    heard: bool = True
    """Whether its messages are received at all."""
    publishers: bool = False
    """Whether it is looked at who publishes it."""
    managed: bool = False
    """Whether a managed node reports its transitions there, whose state is to be known."""
    node: bool = False
    """Whether it is looked at if there is a node of this name."""
    prompt: bool = False
    """Whether a message can be a failure as it comes, so that it is looked at then. A silence, or a condition that must not
    hold for a while, is foretold."""
    parameters: frozenset[tuple[str, str]] = frozenset()
    """The parameters whose changes are reported there and whose values are to be known, each by its node and its own name."""
    pod: bool = False
    """Whether it is not a topic at all, but stands for the pod of the active instance, at which is looked."""
    usage: bool = False
    """Whether it is asked for what that pod takes of its node."""

    @property
    def reliable(self) -> bool:
        """Whether no message may be missed."""
        return self.managed or bool(self.parameters)

    def joined(self, other: WatchedTopic) -> WatchedTopic:
        """What serves this and another need of the same topic."""
        rates = [rate for rate in (self.rate, other.rate) if rate is not None]
        return replace(
            self,
            type=self.type or other.type,
            window=max(self.window, other.window),
            rate=max(rates, default=None),
            contents=max(self.contents, other.contents),
            task=self.task or other.task,
            whole=self.whole or other.whole,
            heard=self.heard or other.heard,
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
    """Why, in plain words with figures; empty while healthy. The figure of a failing rate changes between verdicts."""
    leaf: str
    """Path of the leaf that decided it, such as ``sensors/scan``; empty while healthy."""
    onset: float | None
    """When the last good sample was received (Unix seconds), of a failure; None if there never was one."""


_HEALTHY = Verdict("Healthy", "", "", None)


class HealthTree:
    """The definition of a healthy instance, as py_trees behaviours.

    One tree judges one instance at a time: it remembers, for the present ``since``, which rates have held once.
    All times are Unix seconds.
    """

    def __init__(self, build: Build, evaluation: Evaluation, topics: list[WatchedTopic]) -> None:
        """``build`` makes the behaviours, ``topics`` are all that they look at."""
        self.topics = topics
        """What to subscribe to, each topic once."""
        self._build = build
        self._evaluation = evaluation
        self._left_out: frozenset[str] | None = None
        self._foretold: tuple[Observations, float, float, dict[str, float]] | None = None
        """What the last evaluation found where all was healthy: of what, when, since when, and until when by path of leaf."""
        self.root: Behaviour | None = None
        """The behaviours, with the states of the last evaluation; None if nothing can be judged."""
        self.leave_out(())

    def begin(self, now: float) -> None:
        """Judge from now on (Unix seconds): what the tree names again has the grace to come, though the instance is not new."""
        self._evaluation.begun = now
        self._foretold = None

    def leave_out(self, topics: Collection[str]) -> None:
        """Judge without the leaves of these topics, since they cannot be watched: being blind is no failure.

        A leaf's own path, such as ``sensors/scan``, stands for that one alone. Composites are judged by what is left in
        them. Cheap where nothing changed.
        """
        if topics == self._left_out:
            return
        self._left_out = frozenset(topics)
        self._foretold = None
        self.root = self._build(self._left_out)
        nodes = list(self.root.iterate()) if self.root is not None else []
        self._leaves = [node for node in nodes if isinstance(node, Leaf)]
        # Without an inverter a tree is healthy when all its leaves are, which is nearly always so, and is told without
        # a tick of all its nodes.
        self._upright = not any(isinstance(node, Inverter) for node in nodes)

    @property
    def judged(self) -> list[WatchedTopic]:
        """The topics that are not left out."""
        return [topic for topic in self.topics if topic.name not in (self._left_out or ())]

    def counting(self, observations: Observations, *, now: float, since: float) -> set[str]:
        """The topics whose messages count now: all that are judged but those that are only for a task that is not active."""
        self._look(observations, now, since, real=False)
        return {leaf.topic for leaf in self._leaves if leaf.hears and leaf.counts()}

    @property
    def leaves(self) -> list[Leaf]:
        """The leaves that are judged, with their states at the last evaluation."""
        return list(self._leaves)

    @property
    def blind(self) -> list[str]:
        """Why leaves that are judged cannot judge, in words."""
        return [leaf.blind for leaf in self._leaves if leaf.blind]

    @property
    def grace(self) -> float:
        """Seconds that an instance has to become healthy for the first time."""
        return self._evaluation.grace

    def evaluate(self, observations: Observations, *, now: float, since: float) -> Verdict:
        """The verdict at ``now`` on the instance that has been in control since ``since`` (or was first seen then).

        Look at the topics first, then take ``now``: what has arrived but was not noted counts as missing.
        """
        if self.root is None:
            return Verdict(
                "Starting", f"none of {', '.join(topic.name for topic in self.topics)} can be watched", "", None
            )
        self._foretold = None
        shown = all(leaf.status == Status.SUCCESS for leaf in self._leaves)
        if shown and (until := self._healthy_until(observations, now, since)) is not None:
            for leaf in self._leaves:
                leaf.remember()
            self._foretold = observations, now, since, until
            return _HEALTHY
        state = self._tick(observations, now, since)
        if state == "Healthy":
            return _HEALTHY
        leaves = _decisive(self.root)
        onset = _onset(self.root) if state == "Failed" else None
        return Verdict(state, "; ".join(reason for _, reason in leaves), leaves[0][0].name, onset)

    def deadline(self, observations: Observations, *, now: float, since: float) -> float | None:
        """The first moment at which :meth:`evaluate` would be worse than now if nothing more arrives; None for never.

        Holds until the next message or evaluation; then ask again. Asked after an evaluation, with the same moments and before
        anything more is noted, it costs next to nothing while all is healthy.
        """
        if self.root is None:
            return None
        told, self._foretold = self._foretold, None
        if told is not None and told[0] is observations and told[1:3] == (now, since):
            until: dict[str, float] | None = told[3]
        else:
            until = self._healthy_until(observations, now, since)
        if until is not None:
            moment = _first_loss(self.root, until)
            return moment if math.isfinite(moment) else None
        present = SEVERITY[self._tick(observations, now, since)]
        if present == SEVERITY["Failed"]:
            return None
        found = None
        for moment in sorted({moment for leaf in self._leaves for moment in leaf.changes()}):
            if SEVERITY[self._tick(observations, moment, since, real=False)] > present:
                found = moment
                break
        self._tick(observations, now, since)  # so that the nodes show what is, not what was tried out
        return found

    def next_change(self, observations: Observations, *, now: float, since: float) -> float | None:
        """The first moment after ``now`` at which any leaf may say something else if nothing more arrives; None for never.

        Unlike :meth:`deadline` it is also asked while the tree is failed, and names moments at which it may get better.
        """
        self._look(observations, now, since, real=False)
        return min((moment for leaf in self._leaves for moment in leaf.changes()), default=None)

    def _healthy_until(self, observations: Observations, now: float, since: float) -> dict[str, float] | None:
        """By path, when each leaf stops being healthy; None unless all of them are, and the tree by that."""
        if not self._upright:
            return None
        self._look(observations, now, since, real=True)
        found = {}
        for leaf in self._leaves:
            until = leaf.healthy_until()
            if until is None:
                return None
            found[leaf.name] = until
        return found

    def _look(self, observations: Observations, now: float, since: float, *, real: bool) -> None:
        evaluation = self._evaluation
        evaluation.observations, evaluation.now, evaluation.since, evaluation.real = observations, now, since, real
        if real and evaluation.begun > now:  # the clock was set back since
            evaluation.begun = now

    def _tick(self, observations: Observations, now: float, since: float, *, real: bool = True) -> State:
        self._look(observations, now, since, real=real)
        assert self.root is not None, "there is something to judge"
        for _ in self.root.tick():
            pass
        return STATE[self.root.status]


def _first_loss(node: Behaviour, until: dict[str, float]) -> float:
    """When a node over healthy leaves stops being healthy: alternatives with their last, all else with the first."""
    if isinstance(node, Leaf):
        return until[node.name]
    losses = [_first_loss(child, until) for child in node.children]
    return max(losses) if isinstance(node, AnyOf) else min(losses)


def _decisive(node: Behaviour, *, inverted: bool = False) -> list[tuple[Leaf, str]]:
    """The leaves that gave a node its status, with their reasons, in the tree's order."""
    if isinstance(node, Leaf):
        reason = node.reason(STATE[node.status])
        return [(node, f"{reason}, which must not be" if inverted and node.status != Status.RUNNING else reason)]
    if isinstance(node, While) and not node.counts():
        # It holds on its own, whatever is in it, so that matters only under an inverter.
        leaf = next(inner for inner in node.iterate() if isinstance(inner, Leaf))
        return [(leaf, f"no goal of {node.task.action} is active, which must not be")]
    if isinstance(node, Inverter):
        return _decisive(node.decorated, inverted=not inverted)
    return [found for child in _deciding(node) for found in _decisive(child, inverted=inverted)]


def _deciding(node: Behaviour) -> list[Behaviour]:
    return [child for child in node.children if child.status == node.status]


def _onset(node: Behaviour) -> float | None:
    """When a failed node was last seen to be good."""
    if isinstance(node, Leaf):
        return node.last()
    if isinstance(node, While):
        return _onset(node.decorated)
    if not isinstance(node, Parallel | Sequence | AnyOf):
        return None  # An inverter fails by a message, and the last good moment was no message's.
    onsets = [onset for child in _deciding(node) if (onset := _onset(child)) is not None]
    if not onsets:
        return None
    # What must hold altogether was good until the first was lost, an alternative until the last was.
    return max(onsets) if isinstance(node, AnyOf) else min(onsets)
