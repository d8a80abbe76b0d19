"""The leaf ``progress``: whether an action makes progress with its goal, judged by its feedback."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from understudy.trees.core.evidence import EvidenceTrack, Finding
from understudy.trees.core.health_tree import WatchedTopic
from understudy.trees.core.leaf import LeafPlace, State, duration
from understudy.trees.core.observations import Content, TopicRecord, Unreadable
from understudy.trees.core.task_activity import TaskActive
from understudy.trees.leaves.leaf_plan import Key, LeafKind, LeafPlan, LeafValues, time_key
from understudy.trees.leaves.message_content import ContentLeaf
from understudy.trees.source.expression_values import Undefined
from understudy.trees.source.expressions import ExpressionError, Quantity
from understudy.trees.source.value_reader import found_text, name_of, number_of, type_of

MOST_GOALS = 16
"""Greatest number of goals of one action that are distinguished; most servers have one at a time."""


@dataclass(frozen=True)
class RequiredProgress:
    """The progress that a goal must make."""

    quantity: Quantity
    sign: int
    """-1 if the quantity must fall, 1 if it must grow."""
    by: float
    within: float
    """Seconds."""

    def __str__(self) -> str:
        return f"{'decrease' if self.sign < 0 else 'increase'} by {self.by:g} within {duration(self.within)}"


class ProgressLeaf(ContentLeaf):
    """Holds while no goal is active, or while the active goal makes progress: feedback arrives, and a quantity in it
    improves.

    The quantity must become better than ever before with this goal: a robot that backs up and tries the same way again
    has made no progress.
    """

    def __init__(self, place: LeafPlace, action: str, gap: float | None, aim: RequiredProgress | None) -> None:
        """Make a leaf over an action's feedback. At least one of ``gap`` (seconds) and ``aim`` is given. Its own task
        is the last one."""
        super().__init__(place, feedback_of(action))
        self._action, self._gap, self._aim = action, gap, aim
        self._best: dict[bytes, float] = {}
        self._why = ""

    def forget(self) -> None:
        """Forget the progress of the goals."""
        self._best.clear()
        self._why = ""

    def evaluate(self, content: Content, failed: bool) -> Finding | None:
        """Evaluate the feedback; None if it is no better than earlier feedback."""
        if self._aim is None:
            return Finding(True, "")
        try:
            message: Any = content.message()
            goal = bytes(message.goal_id.uuid)
            value = self._aim.quantity.value(message.feedback)
        except (Unreadable, Undefined) as error:
            self._why = f"its value cannot be determined: {error}"
            return None
        except AttributeError:
            found = type(content.message()).__name__
            self._why = f"its value cannot be determined: a message of type {found} is not feedback of an action"
            return None
        best = self._best.pop(goal, None)  # so that the goal with the oldest feedback comes first
        better = best is None or (value - best) * self._aim.sign >= self._aim.by
        self._best[goal] = value if best is None or better else best
        while len(self._best) > MOST_GOALS:
            del self._best[next(iter(self._best))]
        self._why = f"compared with {self._best[goal]:.6g}"
        return Finding(True, "") if better else None

    # -- the state --------------------------------------------------------------------------------------------------

    def lost(self, track: EvidenceTrack[Content]) -> float:
        """Return when the leaf fails if nothing more arrives."""
        return min(self._silent(), self._stalled(track))

    def _silent(self) -> float:
        """Return when the gap is exceeded if nothing more arrives."""
        if self._gap is None:
            return math.inf
        record = self._record()
        return (
            max(record.last if record is not None and record.last is not None else -math.inf, self.clocks_start())
            + self._gap
        )

    def _stalled(self, track: EvidenceTrack[Content]) -> float:
        """Return when the goal has been without progress for too long if nothing more arrives."""
        if self._aim is None:
            return math.inf
        return max(track.good if track.good is not None else -math.inf, self.clocks_start()) + self._aim.within

    def _record(self) -> TopicRecord | None:
        """Return the feedback's record; None without feedback of this instance."""
        record = self._evaluation.observations.topic(self.topic)
        return record if record is not None and (record.last or -math.inf) >= self._evaluation.since else None

    def last(self) -> float | None:
        """Return the last good time: when feedback with progress was received, or the goal became active."""
        track, record = self.followed(), self._record()
        silent = self._silent() <= self._stalled(track)
        return self._last_with_task(record.last if silent and record is not None else track.good)

    def condition(self) -> str:
        """Return the condition in words."""
        return f"progress of {self._action}"

    def _plain_reason(self, state: State) -> str:
        track, record = self.followed(), self._record()
        if state == "Healthy":
            return f"{self._action} makes progress, or has nothing to do"
        if self._gap is not None and self._evaluation.now >= self._silent() and self._silent() <= self._stalled(track):
            yet = f" for {duration(self._gap)}" if state == "Failed" else " yet"
            return f"no feedback of {self._action}{yet}"
        assert self._aim is not None, "a gap alone fails by the gap"
        has_feedback = record is not None and (record.last or -math.inf) >= self.clocks_start()
        what = f"{self._aim.quantity.text:.80} of {self._action}"
        return f"{what} did not {self._aim} ({self._why if has_feedback and self._why else 'no feedback was received'})"


def feedback_of(action: str) -> str:
    """Return the feedback topic of an action (ROS 2 design: actions)."""
    return f"{action}/_action/feedback"


_MEASURES = ("falls", "grows")


def _check(values: LeafValues) -> None:
    measures = [key for key in _MEASURES if key in values]
    if len(measures) > 1:
        values.problem("grows", "found falls and grows; give the one that shows progress")
    if not measures:
        if "gap" not in values:
            values.problem(
                "", "none of gap, falls and grows is given; give gap, such as 5s, or falls, such as distance_remaining"
            )
        for key in ("by", "within"):
            if key in values:
                values.problem(key, "it is only for falls or grows; give one of these, or remove it")
        return
    for key, right in _OF_MEASURES.items():
        if key not in values:
            values.problem(key, f"missing; give {right}")
    type_ = f"{values['type']}_Feedback" if values["type"] is not None else ""

    def quantity(found: object) -> Quantity:
        if not isinstance(found, str):
            raise ValueError(f"found {found_text(found)}; write a field of the feedback, such as distance_remaining")
        try:
            return Quantity.parse(found, type_, values.fields)
        except ExpressionError as error:
            raise ValueError(f"found {found_text(found)}: {error}") from error

    values.convert(measures[0], quantity)


_OF_MEASURES = {
    "type": "the action's type, such as nav2_msgs/action/NavigateToPose",
    "by": "by how much it must improve, such as 0.2",
    "within": "the time in which it must, such as 20s",
}
"""The keys that a measure needs, and what to give."""


def _plan(values: LeafValues) -> LeafPlan:
    action, gap, type_ = values["action"], values["gap"], values["type"]
    quantities = ((values[key], sign) for key, sign in (("falls", -1), ("grows", 1)) if key in values)
    aim = next((RequiredProgress(one, sign, values["by"], values["within"]) for one, sign in quantities), None)
    feedback = f"{type_}_FeedbackMessage" if type_ is not None else None
    return LeafPlan(
        f"{action.lstrip('/')}.progress",
        WatchedTopic(feedback_of(action), feedback, 0.0, None, contents=1, whole=aim is not None),
        lambda place: ProgressLeaf(place, action, gap, aim),
        TaskActive(action, values["settle"]),
    )


def _by(found: object) -> float:
    if not 0 < (number := number_of(found)) < math.inf:
        raise ValueError(f"found {found_text(found)}; give a number above 0, such as 0.2")
    return number


PROGRESS = LeafKind(
    "progress",
    "while the goal of an action makes progress, or the action has no goal",
    (
        Key(
            "action",
            "the action, fully qualified, such as /navigate_to_pose",
            read=name_of("action", "/navigate_to_pose"),
            missing="give the action's fully qualified name, such as /navigate_to_pose",
        ),
        Key("type", "package/action/Name", read=type_of("action")),
        time_key("gap", "the longest time without feedback, such as 5s"),
        Key("falls", "the number in the feedback that must become less, such as distance_remaining"),
        Key("grows", "the number in the feedback that must become more"),
        Key("by", "by how much it must improve, such as 0.3", "float", read=_by),
        time_key("within", "the time in which it must improve, such as 30s"),
        time_key("settle", "how long it may take to start after the goal became active", default="2s"),
    ),
    "{action: /navigate_to_pose, gap: 5s}",
    _plan,
    _check,
)
