"""Detects which of the policy's situations the robot is in, from what the health tree's subscriptions receive."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

from understudy.api.kinds.failure_policy import FailurePolicySpec, Situation
from understudy.ros.runtime.interface_types import message_fields
from understudy.trees.core.health_tree import HealthTree, WatchedTopic
from understudy.trees.core.observations import Observations
from understudy.trees.core.task_activity import STATUS_TYPE, TaskActive
from understudy.trees.languages.notations import load_inline
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)


class SituationState(NamedTuple):
    """Whether the robot is in a situation."""

    so: bool | None
    """Whether it is; None if that is unknown."""
    reason: str
    """Why it is, without figures, which would differ at every evaluation."""


@dataclass
class _Criterion:
    """How one situation is recognized: by a task or by a tree."""

    task: TaskActive | None = None
    tree: HealthTree | None = None


class ContextDetection:
    """The situations of the policy in force. If it has none, nothing is loaded, watched or judged."""

    def __init__(self) -> None:
        self._situations: list[Situation] = []
        self._signs: dict[str, _Criterion] = {}
        self._blind: Collection[str] = ()
        self.problems: list[str] = []
        """The trees that do not load, and why."""

    def follow(self, policy: FailurePolicySpec) -> bool:
        """Use the situations of this policy. Returns whether they changed. If a tree does not load, the last one stays in force."""
        if self._situations == policy.situations:
            return False
        self._situations, self.problems = policy.situations, []
        self._signs = {one.name: self._sign(one, index) for index, one in enumerate(policy.situations)}
        return True

    def _sign(self, situation: Situation, index: int) -> _Criterion:
        when = situation.when
        if when.task is not None:
            return _Criterion(task=TaskActive(when.task.action))
        try:
            # Without a grace period: a condition that is not seen to hold is false, even if the instance has just become active.
            tree = load_inline(when, path=f"spec.situations[{index}].when", grace=0.0, fields=message_fields)
        except TreeError as error:
            _logger.error("a tree of spec.situations does not load; the last valid one stays in use: %s", error)
            self.problems.append(
                f"The tree of situation {situation.name} does not load. The monitor uses the last valid one until it is corrected: "
                f"{error.in_short()}."
            )
            return self._signs.get(situation.name, _Criterion())
        tree.begin(time.time())
        return _Criterion(tree=tree)

    @property
    def topics(self) -> list[WatchedTopic]:
        """The topics to watch; some may be listed more than once."""
        found: list[WatchedTopic] = []
        for sign in self._signs.values():
            if sign.task is not None:
                found.append(WatchedTopic(sign.task.topic, STATUS_TYPE, 0.0, None, task=True))
            elif sign.tree is not None:
                # Situations are not urgent: a message does not cause an evaluation.
                found += [replace(topic, prompt=False) for topic in sign.tree.topics]
        return found

    def leave_out(self, topics: Collection[str]) -> None:
        """Set the topics that cannot be watched. A tree with one of them has an unknown result."""
        self._blind = topics

    def states(
        self, observations: Observations, goals: Collection[str], *, now: float, since: float
    ) -> dict[str, SituationState]:
        """Return the state of each situation, by name. ``goals`` are the actions that have goals according to the action proxy."""
        return {
            name: self._state(sign, observations, goals, now=now, since=since) for name, sign in self._signs.items()
        }

    def _state(
        self, sign: _Criterion, observations: Observations, goals: Collection[str], *, now: float, since: float
    ) -> SituationState:
        if sign.task is not None:
            # A goal that waits for the next instance still counts as active.
            active = sign.task.action in goals or observations.task(sign.task.topic) is not None
            return SituationState(active, f"a goal of {sign.task.action} is active" if active else "")
        if sign.tree is None or any(topic.name in self._blind for topic in sign.tree.topics):
            return SituationState(None, "")
        verdict = sign.tree.evaluate(observations, now=now, since=since)
        if verdict.state == "Starting":
            return SituationState(None, "")
        return SituationState(verdict.state == "Healthy", "its tree holds" if verdict.state == "Healthy" else "")
