"""The base class of leaves: one condition about one topic."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from understudy.trees.core.observations import Evaluation
from understudy.trees.core.task_activity import TaskActive, task_timing

State = Literal["Healthy", "Starting", "Failed"]

STATUS: dict[State, Status] = {"Healthy": Status.SUCCESS, "Starting": Status.RUNNING, "Failed": Status.FAILURE}
"""How a state is said in py_trees."""

STATE: dict[Status, State] = {status: state for state, status in STATUS.items()}
"""How a status of py_trees is said here."""


class Leaf(Behaviour, ABC):
    """One condition about one topic of the instance that is evaluated.

    One that is for a task is not judged while that is not active. Its clocks begin when it becomes active at the earliest,
    and it has some time to start then.
    """

    hears = True
    """Whether it judges by the topic's messages."""
    kind = ""
    """Its key in the short form; the loader sets it."""
    blind = ""
    """Why it holds though it cannot judge, which is no failure: a mistake in itself, in words. Empty if it can."""
    of_cluster = False
    """Whether only who watches the cluster can tell it, and the ROS graph does not."""

    def __init__(self, path: str, topic: str, evaluation: Evaluation, tasks: Sequence[TaskActive]) -> None:
        super().__init__(path)
        self.topic = topic
        self.tasks = tasks
        self._evaluation = evaluation

    def update(self) -> Status:
        """The state at the time of the evaluation, as py_trees says it."""
        state = self.state()
        if self._evaluation.real:
            if state == "Healthy":
                self.remember()
            if STATUS[state] != self.status or state == "Failed":
                self.feedback_message = self.reason(state)
        return STATUS[state]

    def counts(self) -> bool:
        """Whether it is judged at the time of the evaluation: unless it is for a task that is not active."""
        return not self.tasks or task_timing(self.tasks, self._evaluation) is not None

    @property
    def unrecorded(self) -> str:
        """Why a recording of messages does not tell it, in words; empty if one does."""
        return "" if self.hears else "it needs the live ROS graph, which a bag does not contain"

    def reason(self, state: State) -> str:
        """Why it is in this state, in plain words. Says the same for as long as nothing changes."""
        if self.tasks and state == "Failed":
            actions = " and of ".join(dict.fromkeys(task.action for task in self.tasks))
            return f"{self._plain_reason(state)} while a goal of {actions} is active"
        return self._plain_reason(state)

    def remember(self) -> None:
        """Note that the instance has been healthy here."""

    @abstractmethod
    def state(self) -> State:
        """The state at the time of the evaluation."""

    @abstractmethod
    def healthy_until(self) -> float | None:
        """When it is no longer healthy if nothing more arrives; None if it is not healthy at the time of the evaluation.

        The same as :meth:`state` says, by less work: this is what is asked of every leaf at every tick.
        """

    @abstractmethod
    def changes(self) -> list[float]:
        """The moments after that of the evaluation at which the state may be another with no further message."""

    @abstractmethod
    def last(self) -> float | None:
        """When all was last well, in Unix seconds: a message was received that says so, or its task became active."""

    @abstractmethod
    def _plain_reason(self, state: State) -> str:
        """The reason without the task that it is for."""

    def _last_with_task(self, last: float | None) -> float | None:
        """When all was last well by the messages, or by the task's start, which is later."""
        if not self.tasks or (found := task_timing(self.tasks, self._evaluation)) is None:
            return last
        known = [time for time in (last, found.active) if time is not None and time >= self._evaluation.since]
        return max(known, default=None)

    def _unheard(self, state: State, what: str) -> str:
        """The reason where the instance has not sent what is waited for, such as the topic."""
        if state == "Starting":
            return f"waiting for the first {what}, for up to {duration(self._evaluation.grace)}"
        if state == "Failed" and self.tasks:
            return f"no {what}"
        if state == "Failed":
            return f"no {what} within {duration(self._evaluation.grace)} of the start"
        return f"{what} is silent"


def duration(seconds: float) -> str:
    """A length of time in words, such as ``500 ms`` or ``2 s``."""
    return f"{seconds * 1000:.6g} ms" if seconds < 1 else f"{seconds:.6g} s"
