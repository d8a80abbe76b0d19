"""The leaf ``value``: a condition over the fields of a topic's messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from understudy.trees.core.evidence import Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.observations import Content, Evaluation, Unreadable
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import (
    TYPE,
    Key,
    LeafKind,
    LeafPlan,
    fails_on_arrival,
    hold_off_of,
    time_key,
    topic_key,
    topic_of,
    type_of,
)
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.expression_values import Undefined
from understudy.trees.source.expressions import Expression, ExpressionError, Fields
from understudy.trees.source.value_reader import Reader, found_text


class ValueLeaf(ContentLeaf):
    """Holds while a condition is true for the newest message.

    With ``recovers``, a failed leaf holds again only when that condition is true.
    """

    def __init__(
        self,
        path: str,
        topic: str,
        evaluation: Evaluation,
        holds: Expression,
        recovers: Expression | None = None,
        *,
        hold_off: float = 0.0,
        tasks: Sequence[TaskActive] = (),
    ) -> None:
        """Make a leaf over a topic; ``hold_off`` in seconds."""
        super().__init__(path, topic, evaluation, hold_off=hold_off, tasks=tasks)
        self._holds, self._recovers = holds, recovers

    def said(self, content: Content, failed: bool) -> Finding:
        """Evaluate the values of the message."""
        wanted = self._recovers if failed and self._recovers is not None else self._holds
        try:
            message = content.message()
        except Unreadable as error:
            return Finding(False, f"it cannot be determined: {error}")
        try:
            if wanted.holds(message):
                return Finding(True, "")
            values = wanted.values(message).replace(" is ", " was ")
            return Finding(False, values)
        except Undefined as error:
            return Finding(False, f"it cannot be determined: {error}")

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
        WatchedTopic(topic, type_, 0.0, None, contents=1, whole=True, prompt=fails_on_arrival(hold_off)),
        lambda place, evaluation, tasks: ValueLeaf(
            place, topic, evaluation, holds, recovers, hold_off=hold_off, tasks=tasks
        ),
    )


VALUE = LeafKind(
    "value",
    "while a condition over the fields of the messages holds",
    (
        topic_key("/battery_state"),
        TYPE,
        Key("holds", "the condition that must hold, such as percentage > 0.15"),
        Key("recovers", "the condition that must hold again after a failure"),
        time_key("for", "how long the condition must not hold before that is a failure, such as 500ms"),
    ),
    _EXAMPLE,
    _read,
)
