"""The leaf ``lifecycle``: the state of a managed node (ROS 2 design: managed nodes)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.core.evidence import EvidenceLeaf, Said, Track
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import Glance, NodeState
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import LeafKind, LeafPlan, at_once, hold_off_of, node_of
from understudy.trees.source.expressions import Fields
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import Reader, found_text

TYPE = "lifecycle_msgs/msg/TransitionEvent"

EVENTS = "/transition_event"
"""Where a managed node tells of its transitions, after its name."""

STATES = ("unconfigured", "inactive", "active", "finalized")
"""States in which a managed node rests."""

BURST = 100.0
"""Transitions per second to be ready for: a whole stack is brought up at once, two for each step."""


class LifecycleLeaf(EvidenceLeaf[NodeState]):
    """Holds while a managed node is in a state, or while that can't be told."""

    hears = False

    def __init__(
        self,
        path: str,
        node: str,
        glance: Glance,
        state: str = "active",
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """A leaf over a node, fully qualified; ``hold_off`` in seconds."""
        super().__init__(path, f"{node}{EVENTS}", glance, hold_off=hold_off, tasks=tasks)
        self._node, self._state = node, state

    def _found(self) -> NodeState | None:
        """What is known of it since the instance took control."""
        found = self._glance.observations.lifecycle(self._node)
        return found if found is not None and found.received >= self._glance.since else None

    def fresh(self, track: Track[NodeState]) -> list[NodeState]:
        """What is known now, once."""
        found = self._found()
        return [found] if found is not None and found is not track.seen else []

    def said(self, content: NodeState, failed: bool) -> Said | None:
        """What it says of the state."""
        if content.state is None:
            return None
        if content.state == self._state:
            return Said(True, "")
        why = f"it is {content.state}" if content.state else "it is not there"
        if self._track.bad is not None:
            self._track.why = why  # on its way from state to state the last one tells most
        return Said(False, why)

    def _limits(self, track: Track[NodeState]) -> tuple[float, float]:
        found = self._found()
        if found is not None and found.state is None:
            return math.inf, math.inf  # being blind is no failure
        return super()._limits(track)

    def condition(self) -> str:
        """The condition in words."""
        return f"state {self._state} of node {self._node}"

    def awaited(self) -> str:
        """What must come first."""
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
            f"{node}{EVENTS}", TYPE, 0.0, BURST, contents=1, whole=True, managed=True, prompt=at_once(hold_off)
        ),
        lambda place, glance, tasks: LifecycleLeaf(place, node, glance, state, hold_off=hold_off, tasks=tasks),
    )


def _state(found: object) -> str:
    if found not in STATES:
        hint = did_you_mean(found, STATES) if isinstance(found, str) else f"; known are {', '.join(STATES)}"
        raise ValueError(f"found {found_text(found)}{hint}")
    return str(found)


LIFECYCLE = LeafKind(("node", "state", "for"), _EXAMPLE, _read)
