"""Evaluates a health tree over a bag with a virtual clock, which advances to the next possible change.

There is no tick period. A change is the receipt of a message or a time that the tree predicts, so a 500 ms gap is detected
exactly 500 ms after the last receipt.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from understudy.cli.common.errors import CommandError
from understudy.cli.simulate.bags import Bag, BagTrack, Recorded
from understudy.cli.simulate.leaf_history import Evaluation
from understudy.ros.observe.message_contents import ours
from understudy.trees.core.health_tree import HealthTree, WatchedTopic
from understudy.trees.core.observations import RecordedObservations as Observed
from understudy.trees.core.observations import TopicRecord, Unreadable
from understudy.trees.core.task_activity import ACTIVE_STATUSES
from understudy.trees.leaves.diagnostics import TYPE as DIAGNOSTICS


@dataclass(frozen=True)
class LeftOut:
    """A part of the tree that a bag cannot answer."""

    leaves: tuple[str, ...]
    """Paths of the leaves that are not evaluated for this reason."""
    why: str


@dataclass
class Replay:
    """The result of evaluating a policy over a bag."""

    evaluation: Evaluation
    left_out: list[LeftOut]
    arrivals: Mapping[str, array[float]]
    """Times of receipt of each topic of the tree, in unix seconds."""
    topics: dict[str, str] = field(default_factory=dict)
    """By path, the topic of each evaluated leaf."""

    def received(self, path: str) -> array[float]:
        """Return the times of receipt of a leaf's topic, in unix seconds."""
        return self.arrivals.get(self.topics[path], array("d"))


def replay(tree: HealthTree, debounce: float, bag: Bag) -> Replay:
    """Evaluate a bag with a policy's tree and its debounce (seconds). Raises CommandError."""
    left_out = _leave_out(tree, bag)
    if tree.root is None:
        reasons = "\n".join(f"{', '.join(one.leaves)}: {one.why}" for one in left_out)
        raise CommandError(f"{bag.path}: this bag contains nothing that the policy's tree can evaluate\n{reasons}")
    # Topics that only skipped leaves need are not read.
    out = {path for one in left_out for path in one.leaves}
    recorded = [topic for topic in tree.topics if topic.subscribed and topic.name in bag.topics]
    wanted = {topic.name: topic for topic in recorded if _without(tree, out, topic.name)}
    types = {name: _type(topic, bag) for name, topic in wanted.items()}
    received = _Received(wanted, types, bag)
    evaluation = Evaluation(tree, debounce, bag.start)
    _run(evaluation, received, bag, types)
    evaluation.end(bag.end)
    return Replay(evaluation, left_out, received.arrivals, {leaf.name: leaf.topic for leaf in tree.leaves})


class _Received:
    """Everything received until the virtual time."""

    def __init__(self, wanted: Mapping[str, WatchedTopic], types: Mapping[str, str], bag: Bag) -> None:
        self._wanted, self._types, self._definitions = wanted, types, bag.definitions
        self._records = {name: TopicRecord(topic.window, topic.contents) for name, topic in wanted.items()}
        self._tasks: dict[str, float] = {}
        self.observations = Observed(self._records, self._tasks)
        self.arrivals = {name: array("d") for name in wanted}

    def take(self, taken: BagTrack) -> None:
        """Add a message."""
        if self._types[taken.topic] == DIAGNOSTICS and ours(taken.data):
            return
        want = self._wanted[taken.topic]
        record = self._records[taken.topic]
        record.add(taken.received)
        self.arrivals[taken.topic].append(taken.received)
        if want.contents:
            record.contents.append(Recorded(taken, self._types[taken.topic], self._definitions))
        if want.task:
            self._note_goals(taken)

    def _note_goals(self, taken: BagTrack) -> None:
        try:
            status: Any = Recorded(taken, self._types[taken.topic], self._definitions).message()
        except Unreadable:
            return
        if any(goal.status in ACTIVE_STATUSES for goal in status.status_list):
            self._tasks.setdefault(taken.topic, taken.received)
        else:
            self._tasks.pop(taken.topic, None)


def _run(evaluation: Evaluation, received: _Received, bag: Bag, types: Mapping[str, str]) -> None:
    observations, now = received.observations, bag.start
    following: Iterator[BagTrack] = bag.messages(types)
    coming = next(following, None)
    while True:
        while coming is not None and coming.received <= now:
            received.take(coming)
            coming = next(following, None)
        evaluation.evaluate(observations, now)
        change = evaluation.next_evaluation(observations, now)
        moments = [moment for moment in (change, coming.received if coming else None) if moment is not None]
        if not moments or min(moments) > bag.end:
            return
        now = min(moments)


def _leave_out(tree: HealthTree, bag: Bag) -> list[LeftOut]:
    """Remove the leaves from the evaluation that the bag cannot answer, and return them."""
    leaves = {leaf.name: leaf for leaf in tree.leaves}
    unrecorded = {path for path, leaf in leaves.items() if leaf.unrecorded}
    lacking = [topic for topic in tree.topics if topic.subscribed and topic.name not in bag.topics]
    found = [LeftOut((path,), f"{leaf.unrecorded} ({leaf.topic})") for path, leaf in leaves.items() if leaf.unrecorded]
    for topic in lacking:
        gone = tuple(path for path in leaves if path in _without(tree, unrecorded, topic.name))
        if gone:
            why = f"the bag does not contain {topic.name}{', which reports whether the task is active' if topic.task else ''}"
            found.append(LeftOut(gone, f"{why}; {_HIDDEN}" if "/_action/" in topic.name else why))
    tree.leave_out({topic.name for topic in lacking} | unrecorded)
    return found


_HIDDEN = "`ros2 bag record` skips it unless --include-hidden-topics is given"


def _without(tree: HealthTree, left_out: Collection[str], topic: str) -> set[str]:
    """Return the paths of the leaves that depend on a topic, with other leaves removed already."""
    tree.leave_out(set(left_out))
    before = {leaf.name for leaf in tree.leaves}
    tree.leave_out({*left_out, topic})
    gone = before - {leaf.name for leaf in tree.leaves}
    tree.leave_out(set(left_out))
    return gone


def _type(topic: WatchedTopic, bag: Bag) -> str:
    """Return the message type of a topic. Raises CommandError."""
    recorded = bag.topics[topic.name].types
    if topic.type is None and len(recorded) > 1:
        raise CommandError(
            f"{bag.path}: {topic.name} was recorded as {' and as '.join(recorded)}: set the type in the policy's tree"
        )
    wanted = topic.type or recorded[0]
    if wanted not in recorded:
        raise CommandError(
            f"{bag.path}: the policy's tree has the type {wanted} for {topic.name}, but it was recorded as {' and as '.join(recorded)}; "
            "a monitor would receive nothing, so correct the type in the tree"
        )
    if (topic.contents or topic.task) and bag.definitions.fields(wanted) is None:
        raise CommandError(
            f"{bag.path}: the type {wanted} of {topic.name} is unknown, but the tree reads its messages: the bag contains no "
            "readable definition of it; record it as MCAP or with ROS 2 Iron or newer, which store the definitions too"
        )
    return wanted
