"""The leaf ``value``: a condition over the fields of a topic's messages."""

from __future__ import annotations

from dataclasses import replace

from understudy.trees.core.evidence import Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace
from understudy.trees.core.observations import Content, Unreadable
from understudy.trees.leaves.leaf_plan import (
    TYPE,
    Key,
    LeafKind,
    LeafPlan,
    LeafValues,
    fails_on_arrival,
    time_key,
    topic_key,
)
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.expression_values import Undefined
from understudy.trees.source.expressions import Expression, ExpressionError
from understudy.trees.source.value_reader import found_text


class ValueLeaf(ContentLeaf):
    """Holds while a condition is true for the newest message.

    With ``recovers``, a failed leaf holds again only when that condition is true.
    """

    def __init__(
        self, place: LeafPlace, topic: str, hold_off: float, holds: Expression, recovers: Expression | None
    ) -> None:
        """Make a leaf over a topic; ``hold_off`` in seconds."""
        super().__init__(place, topic, hold_off)
        self._holds, self._recovers = holds, recovers

    def evaluate(self, content: Content, failed: bool) -> Finding:
        """Evaluate the values of the message."""
        wanted = self._recovers if failed and self._recovers is not None else self._holds
        try:
            message = content.message()
        except Unreadable as error:
            return Finding(False, f"{self.topic} cannot be judged: {error}")
        try:
            if wanted.holds(message):
                return Finding(True, "")
            values = wanted.values(message).replace(" is ", " was ")
            return Finding(False, f"{self.topic}: {values}" if values else f"{self.topic} does not meet the condition")
        except Undefined as error:
            return Finding(False, f"{self.topic} cannot be judged: {error}")

    def condition(self) -> str:
        """Return the condition in words."""
        return f"{self._text()} of {self.topic}"

    def requirement(self) -> str:
        """Return what the condition requires."""
        return f"{self._text()} is required"

    def _text(self) -> str:
        text = self._holds.text
        return text if len(text) <= 80 else f"{text[:77]}..."


def _check(values: LeafValues) -> None:
    def expression(found: object) -> Expression:
        if not isinstance(found, str):
            raise ValueError(f"found {found_text(found)}; write a condition in quotes, such as 'percentage > 0.15'")
        try:
            return Expression.parse(found, values["type"] or "", values.fields)
        except ExpressionError as error:
            raise ValueError(f"found {found_text(found)}: {error}") from error

    values.convert("holds", expression)
    values.convert("recovers", expression)


def _plan(values: LeafValues) -> LeafPlan:
    topic, hold_off, holds, recovers = values["topic"], values.hold_off, values["holds"], values["recovers"]
    return LeafPlan(
        f"{topic.lstrip('/')}.value",
        WatchedTopic(topic, values["type"], 0.0, None, contents=1, whole=True, prompt=fails_on_arrival(hold_off)),
        lambda place: ValueLeaf(place, topic, hold_off, holds, recovers),
    )


VALUE = LeafKind(
    "value",
    "while a condition over the fields of the messages holds",
    (
        topic_key("/battery_state"),
        replace(TYPE, missing="give the messages' type, such as sensor_msgs/msg/BatteryState"),
        Key(
            "holds",
            "the condition that must hold, such as percentage > 0.15",
            missing="give the condition that must hold, such as 'percentage > 0.15'",
        ),
        Key("recovers", "the condition that must hold again after a failure"),
        time_key("for", "how long the condition may be false before that is a failure, such as 500ms"),
    ),
    '{topic: /battery_state, type: sensor_msgs/msg/BatteryState, holds: "percentage > 0.15"}',
    _plan,
    _check,
)
