"""Tasks that decide whether a part of a health tree is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.decorators import Decorator

from understudy.trees.core.observations import Evaluation

STATUS_TYPE = "action_msgs/msg/GoalStatusArray"

ACTIVE_STATUSES = (2, 3)
"""Statuses of a goal that make a task active (action_msgs/msg/GoalStatus): executing and canceling. A goal that is only
accepted does not count: no instance works on it (yet), as with a goal that the task proxy holds between two instances.
"""

SETTLE = 2.0
"""Seconds after a task has become active within which what it needs may start, if the tree does not state them."""


@dataclass(frozen=True)
class TaskActive:
    """Holds while an action has a goal that is being executed or cancelled."""

    action: str
    settle: float = SETTLE
    """Seconds."""

    @property
    def topic(self) -> str:
        """The topic on which the action's server publishes the statuses of its goals (ROS 2 design: actions)."""
        return f"{self.action}/_action/status"

    def since(self, evaluation: Evaluation) -> float | None:
        """Return when the task became active, in Unix seconds; None while it is not."""
        return evaluation.observations.task(self.topic)


@dataclass(frozen=True)
class TaskTiming:
    """The times from which a leaf is evaluated, in Unix seconds."""

    active: float
    """When the last of its tasks became active: the leaf's clock starts then at the earliest."""
    settled: float
    """The end of the time in which the evaluated messages may start."""


def task_timing(tasks: Sequence[TaskActive], evaluation: Evaluation) -> TaskTiming | None:
    """Return the times of a leaf with these tasks; None while one of them is not active."""
    active = settled = float("-inf")
    for task in tasks:
        since = task.since(evaluation)
        if since is None:
            return None
        active, settled = max(active, since), max(settled, since + task.settle)
    return TaskTiming(active, settled)


class While(Decorator):
    """Has its child's status while a task is active, and otherwise succeeds."""

    def __init__(self, name: str, child: Behaviour, task: TaskActive, evaluation: Evaluation) -> None:
        super().__init__(name, child)
        self.task = task
        self._evaluation = evaluation

    def counts(self) -> bool:
        """Return whether its child is judged at the time of the evaluation."""
        return self.task.since(self._evaluation) is not None

    def update(self) -> Status:
        """Return the child's status, if it counts."""
        return self.decorated.status if self.counts() else Status.SUCCESS
