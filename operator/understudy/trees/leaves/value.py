"""The leaf ``value``: a condition over the fields of a topic's messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.core.evidence import Said
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import Content, Glance, Unreadable
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import LeafKind, LeafPlan, at_once, hold_off_of, topic_of, type_of
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.expressions import Expression, ExpressionError, Fields, Untold
from understudy.trees.source.value_reader import Reader, found_text


class ValueLeaf(ContentLeaf):
    """Holds while a condition does of the newest message.

    With ``recovers``, one that has failed holds again only when that does.
    """

    def __init__(
        self,
        path: str,
        topic: str,
        glance: Glance,
        holds: Expression,
        recovers: Expression | None = None,
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """A leaf over a topic; ``hold_off`` in seconds."""
        super().__init__(path, topic, glance, hold_off=hold_off, tasks=tasks)
        self._holds, self._recovers = holds, recovers

    def said(self, content: Content, failed: bool) -> Said:
        """What the message says by its values."""
        wanted = self._recovers if failed and self._recovers is not None else self._holds
        try:
            message = content.message()
        except Unreadable as error:
            return Said(False, f"it can't be told: {error}")
        try:
            if wanted.holds(message):
                return Said(True, "")
            values = wanted.values(message).replace(" is ", " was ")
            return Said(False, values)
        except Untold as error:
            return Said(False, f"it can't be told: {error}")

    def condition(self) -> str:
        """The condition in words."""
        text = self._holds.text
        return f"{text if len(text) <= 80 else f'{text[:77]}...'} of {self.topic}"


_EXAMPLE = '{topic: /battery_state, type: sensor_msgs/msg/BatteryState, holds: "percentage > 0.15"}'


def _read(reader: Reader, value: Mapping[str, Any], path: str, fields: Fields | None) -> LeafPlan | None:
    before = len(reader.problems)
    topic = topic_of(reader, value, path, "/battery_state")
    type_ = type_of(reader, value, path)
    if "type" not in value:
        reader.problem(f"{path}.type", "missing; give the messages' type, such as sensor_msgs/msg/BatteryState")
    if "holds" not in value:
        reader.problem(f"{path}.holds", "missing; give the condition that must hold, such as 'percentage > 0.15'")

    def expression(found: object) -> Expression:
        if not isinstance(found, str):
            raise ValueError(f"found {found_text(found)}; write a condition in quotes, such as 'percentage > 0.15'")
        try:
            return Expression.parse(found, type_ or "", fields)
        except ExpressionError as error:
            raise ValueError(f"found {found_text(found)}: {error}") from error

    holds = reader.given(value, "holds", path, expression)
    recovers = reader.given(value, "recovers", path, expression)
    hold_off = hold_off_of(reader, value, path)
    if topic is None or holds is None or len(reader.problems) > before:
        return None
    return LeafPlan(
        f"{topic.lstrip('/')}.value",
        WatchedTopic(topic, type_, 0.0, None, contents=1, whole=True, prompt=at_once(hold_off)),
        lambda place, glance, tasks: ValueLeaf(place, topic, glance, holds, recovers, hold_off=hold_off, tasks=tasks),
    )


VALUE = LeafKind(("topic", "type", "holds", "recovers", "for"), _EXAMPLE, _read)
