"""The leaf ``lifecycle``: the state of a managed node (ROS 2 design: managed nodes)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.core.evidence import EvidenceLeaf, EvidenceTrack, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import Evaluation, NodeState
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, fails_on_arrival, hold_off_of, node_of, time_key
from understudy.trees.source.expressions import Fields
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import Reader, found_text

TYPE = "lifecycle_msgs/msg/TransitionEvent"

EVENTS = "/transition_event"
"""Suffix of the topic on which a managed node reports its transitions, after the node's name."""

STATES = ("unconfigured", "inactive", "active", "finalized")
"""States in which a managed node rests."""

BURST = 100.0
"""Expected transitions per second: a whole stack is brought up at once, with two for each step."""


class LifecycleLeaf(EvidenceLeaf[NodeState]):
    """Holds while a managed node is in a state, or while its state cannot be determined."""

    hears = False

    def __init__(
        self,
        path: str,
        node: str,
        evaluation: Evaluation,
        state: str = "active",
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """Make a leaf over a node, fully qualified; ``hold_off`` in seconds."""
        super().__init__(path, f"{node}{EVENTS}", evaluation, hold_off=hold_off, tasks=tasks)
        self._node, self._state = node, state

    def _found(self) -> NodeState | None:
        """Return the known state of the node since the instance took control."""
        found = self._evaluation.observations.lifecycle(self._node)
        return found if found is not None and found.received >= self._evaluation.since else None

    def fresh(self, track: EvidenceTrack[NodeState]) -> list[NodeState]:
        """Return the known state, once."""
        found = self._found()
        return [found] if found is not None and found is not track.seen else []

    def said(self, content: NodeState, failed: bool) -> Finding | None:
        """Evaluate the state."""
        if content.state is None:
            return None
        if content.state == self._state:
            return Finding(True, "")
        why = f"it is {content.state}" if content.state else "it is not there"
        if self._track.bad is not None:
            self._track.why = why  # while the node changes its state, the last state says most
        return Finding(False, why)

    def _limits(self, track: EvidenceTrack[NodeState]) -> tuple[float, float]:
        found = self._found()
        if found is not None and found.state is None:
            return math.inf, math.inf  # being unable to judge is not a failure
        return super()._limits(track)

    def condition(self) -> str:
        """The condition in words."""
        return f"state {self._state} of node {self._node}"

    def awaited(self) -> str:
        """What must arrive first."""
        return f"answer of node {self._node} to what state it is in"


_EXAMPLE = "{node: /controller_server}"


def _read(reader: Reader, value: Mapping[str, Any], path: str, fields: Fields | None) -> LeafPlan | None:
    before = len(reader.problems)
    node = node_of(reader, value, path)
    state = reader.given(value, "state", path, _state) if "state" in value else "active"
    hold_off = hold_off_of(reader, value, path)
    if node is None or len(reader.problems) > before:
        return None
    return LeafPlan(
        f"{node.lstrip('/')}.lifecycle",
        WatchedTopic(
            f"{node}{EVENTS}", TYPE, 0.0, BURST, contents=1, whole=True, managed=True, prompt=fails_on_arrival(hold_off)
        ),
        lambda place, evaluation, tasks: LifecycleLeaf(place, node, evaluation, state, hold_off=hold_off, tasks=tasks),
    )


def _state(found: object) -> str:
    if found not in STATES:
        hint = did_you_mean(found, STATES) if isinstance(found, str) else f"; known are {', '.join(STATES)}"
        raise ValueError(f"found {found_text(found)}{hint}")
    return str(found)


LIFECYCLE = LeafKind(
    "lifecycle",
    "while a managed node is in a state",
    (
        Key("node", "the managed node, fully qualified, such as /controller_server"),
        Key("state", "unconfigured, inactive, active or finalized", "lifecycle_state", STATES, "active"),
        time_key("for", "how long it must be in another state before that is a failure, such as 1s"),
    ),
    _EXAMPLE,
    _read,
)
