"""The leaf ``publisher``: whether a topic has publishers, according to the ROS graph."""

from __future__ import annotations

from understudy.trees.core.evidence import EvidenceLeaf, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import Publishers
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, node_key, time_key, topic_key
from understudy.trees.source.value_reader import whole_number_of

MOST = 1000
"""Greatest number of publishers that a tree may require; topics have a few."""


class PublisherLeaf(EvidenceLeaf[Publishers]):
    """Holds while enough publishers of the instance exist for a topic, in one node or in any."""

    uses_messages = False

    def __init__(self, place: LeafPlace, topic: str, hold_off: float, count: int, node: str | None) -> None:
        """Make a leaf over a topic; ``node`` is fully qualified, ``hold_off`` in seconds."""
        super().__init__(place, topic, hold_off)
        self._count, self._node = count, node

    def newest(self) -> Publishers | None:
        """Return the last observation of the ROS graph."""
        return self._evaluation.observations.publishers(self.topic)

    def evaluate(self, content: Publishers, failed: bool) -> Finding:
        """Evaluate the observation."""
        count = sum(self._node in (None, node) for node in content.nodes)
        if count >= self._count:
            return Finding(True, "")
        subject = f"node {self._node}" if self._node is not None else "the instance"
        publishers = f"{count or 'no'} publisher{'s' if count > 1 else ''}"
        return Finding(False, f"{subject} has {publishers} of {self.topic}")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"a count of at least {self._count} publisher{'s' if self._count > 1 else ''} of {self._asked()}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"at least {self._count} {'are' if self._count > 1 else 'is'} required"

    def awaited(self) -> str:
        """Return what must arrive first."""
        return f"observation of the publishers of {self._asked()}"

    def _asked(self) -> str:
        return f"{self.topic} in node {self._node}" if self._node is not None else self.topic


def _plan(values: LeafValues) -> LeafPlan:
    topic, hold_off, count, node = values["topic"], values.hold_off, values["count"], values["node"]
    return LeafPlan(
        f"{topic.lstrip('/')}.publisher",
        WatchedTopic(topic, None, 0.0, None, subscribed=False, publishers=True),
        lambda place: PublisherLeaf(place, topic, hold_off, count, node),
    )


PUBLISHER = LeafKind(
    "publisher",
    "while the topic has a publisher",
    (
        topic_key("/cmd_vel"),
        Key("count", "the least number of publishers, such as 1", "int", default="1", read=whole_number_of(MOST)),
        node_key("the node that the publishers must be in, such as /controller_server", required=False),
        time_key("for", "how long there may be fewer before that is a failure, such as 2s"),
    ),
    "{topic: /cmd_vel, node: /controller_server}",
    _plan,
)
