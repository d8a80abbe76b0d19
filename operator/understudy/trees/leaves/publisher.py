"""The leaf ``publisher``: whether a topic has publishers, according to the ROS graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.ros_names import ROS_NAME_PATTERN
from understudy.trees.core.evidence import EvidenceLeaf, EvidenceTrack, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import Evaluation, Publishers
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, hold_off_of, time_key, topic_key, topic_of
from understudy.trees.source.expressions import Fields
from understudy.trees.source.value_reader import Reader, whole_number_of

MOST = 1000
"""Greatest number of publishers that a tree may require; topics have a few."""


class PublisherLeaf(EvidenceLeaf[Publishers]):
    """Holds while enough publishers of the instance exist for a topic, in one node or in any."""

    hears = False

    def __init__(
        self,
        path: str,
        topic: str,
        evaluation: Evaluation,
        count: int = 1,
        node: str | None = None,
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """Make a leaf over a topic; ``node`` is fully qualified, ``hold_off`` in seconds."""
        super().__init__(path, topic, evaluation, hold_off=hold_off, tasks=tasks)
        self._count, self._node = count, node

    def fresh(self, track: EvidenceTrack[Publishers]) -> list[Publishers]:
        """Return the last observation of the ROS graph, once."""
        found = self._evaluation.observations.publishers(self.topic)
        if found is None or found is track.seen or found.received < self._evaluation.since:
            return []
        return [found]

    def said(self, content: Publishers, failed: bool) -> Finding:
        """Evaluate the observation."""
        count = sum(self._node in (None, node) for node in content.nodes)
        if count >= self._count:
            return Finding(True, "")
        return Finding(False, f"there {'is' if count == 1 else 'are'} {count}" if count else "there is none")

    def condition(self) -> str:
        """The condition in words."""
        return f"a count of at least {self._count} publisher{'s' if self._count > 1 else ''} of {self._asked()}"

    def awaited(self) -> str:
        """What must arrive first."""
        return f"look at the publishers of {self._asked()}"

    def _asked(self) -> str:
        return f"{self.topic} in node {self._node}" if self._node is not None else self.topic


_EXAMPLE = "{topic: /cmd_vel, node: /controller_server}"


def _read(reader: Reader, value: Mapping[str, Any], path: str, fields: Fields | None) -> LeafPlan | None:
    before = len(reader.problems)
    topic = topic_of(reader, value, path, "/cmd_vel")
    count = reader.given(value, "count", path, whole_number_of(MOST)) if "count" in value else 1
    node = reader.matching(
        value, "node", path, ROS_NAME_PATTERN, "a node's fully qualified name such as /controller_server"
    )
    hold_off = hold_off_of(reader, value, path)
    if topic is None or count is None or len(reader.problems) > before:
        return None
    return LeafPlan(
        f"{topic.lstrip('/')}.publisher",
        WatchedTopic(topic, None, 0.0, None, heard=False, publishers=True),
        lambda place, evaluation, tasks: PublisherLeaf(
            place, topic, evaluation, count, node, hold_off=hold_off, tasks=tasks
        ),
    )


PUBLISHER = LeafKind(
    "publisher",
    "while the topic has a publisher",
    (
        topic_key("/cmd_vel"),
        Key("count", "the least number of publishers, such as 1", "int", default="1"),
        Key("node", "the node that the publishers must be in, such as /controller_server"),
        time_key("for", "how long there must be fewer before that is a failure, such as 2s"),
    ),
    _EXAMPLE,
    _read,
)
