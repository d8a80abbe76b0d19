"""The leaf ``node``: whether the instance has a node, according to the ROS graph."""

from __future__ import annotations

from understudy.trees.core.evidence import EvidenceLeaf, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import State, duration
from understudy.trees.core.observations import NodePresence
from understudy.trees.leaves.leaf_plan import LeafKind, LeafPlan, LeafValues, node_key, time_key


class NodeLeaf(EvidenceLeaf[NodePresence]):
    """Holds while the instance has a node of a name."""

    uses_messages = False

    def newest(self) -> NodePresence | None:
        """Return the last observation of the ROS graph."""
        return self._evaluation.observations.node(self.topic)

    def evaluate(self, content: NodePresence, failed: bool) -> Finding:
        """Evaluate the observation."""
        if content.there:
            return Finding(True, "")
        # If a node of this name is in another pod, a user sees it with `ros2 node list` and needs this explanation.
        return Finding(False, "another instance or the robot has one of that name" if content.elsewhere else "")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"node {self.topic}"

    def awaited(self) -> str:
        """Return what must arrive first."""
        return f"observation of node {self.topic}"

    def _plain_reason(self, state: State) -> str:
        track, node = self.followed(), self.condition()
        if track.last_finding is None:
            return super()._plain_reason(state)
        why = f" ({track.why})" if track.why else ""
        if state == "Healthy":
            return f"{node} is there" if track.held else f"{node} is not required yet"
        if state == "Starting":
            return f"{node} is not there yet{why}"
        if not track.held and not self.tasks:
            return f"{node} did not appear within {duration(self._evaluation.grace)} of the start{why}"
        return (
            f"{node} has been missing for {duration(self.hold_off)}{why}" if self.hold_off else f"{node} is gone{why}"
        )


def _plan(values: LeafValues) -> LeafPlan:
    node, hold_off = values["name"], values.hold_off
    return LeafPlan(
        f"{node.lstrip('/')}.node",
        WatchedTopic(node, None, 0.0, None, subscribed=False, node=True),
        lambda place: NodeLeaf(place, node, hold_off),
    )


NODE = LeafKind(
    "node",
    "while the instance has the node",
    (
        node_key("the node, fully qualified, such as /controller_server", name="name", xml="node"),
        time_key("for", "how long it may be missing before that is a failure, such as 2s"),
    ),
    "{name: /controller_server}",
    _plan,
)
