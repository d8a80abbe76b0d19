"""The leaf ``lifecycle``: the state of a managed node (ROS 2 design: managed nodes)."""

from __future__ import annotations

from understudy.trees.core.evidence import AnswerLeaf
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import NodeState
from understudy.trees.leaves.leaf_plan import (
    LeafKind,
    LeafPlan,
    LeafValues,
    fails_on_arrival,
    node_key,
    time_key,
    word_key,
)

TYPE = "lifecycle_msgs/msg/TransitionEvent"

EVENTS = "/transition_event"
"""Suffix of the topic on which a managed node reports its transitions, after the node's name."""

STATES = ("unconfigured", "inactive", "active", "finalized")
"""States in which a managed node rests."""

BURST = 100.0
"""Expected transitions per second: a whole stack is brought up at once, with two for each step."""


class LifecycleLeaf(AnswerLeaf[NodeState]):
    """Holds while a managed node is in a state, or while its state cannot be determined."""

    def __init__(self, place: LeafPlace, node: str, hold_off: float, state: str) -> None:
        """Make a leaf over a node, fully qualified; ``hold_off`` in seconds."""
        super().__init__(place, f"{node}{EVENTS}", hold_off)
        self._node, self._state = node, state

    def newest(self) -> NodeState | None:
        """Return the known state of the node."""
        return self._evaluation.observations.lifecycle(self._node)

    def wrong(self, content: NodeState) -> str:
        """Return which other state it is in."""
        if content.state == self._state:
            return ""
        return f"node {self._node} is {content.state}" if content.state else f"node {self._node} is not there"

    def condition(self) -> str:
        """Return the condition in words."""
        return f"state {self._state} of node {self._node}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"{self._state} is required"

    def awaited(self) -> str:
        """Return what must arrive first."""
        return f"answer of node {self._node} about its lifecycle state"


def _plan(values: LeafValues) -> LeafPlan:
    node, hold_off, state = values["node"], values.hold_off, values["state"]
    prompt = fails_on_arrival(hold_off)
    return LeafPlan(
        f"{node.lstrip('/')}.lifecycle",
        WatchedTopic(f"{node}{EVENTS}", TYPE, 0.0, BURST, contents=1, whole=True, managed=True, prompt=prompt),
        lambda place: LifecycleLeaf(place, node, hold_off, state),
    )


LIFECYCLE = LeafKind(
    "lifecycle",
    "while a managed node is in a state",
    (
        node_key("the managed node, fully qualified, such as /controller_server"),
        word_key("state", "unconfigured, inactive, active or finalized", "lifecycle_state", STATES, default="active"),
        time_key("for", "how long it may be in another state before that is a failure, such as 1s"),
    ),
    "{node: /controller_server}",
    _plan,
)
