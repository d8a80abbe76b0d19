"""The base class of leaves: one condition about one topic."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from understudy.api.plain_text import one_line
from understudy.trees.core.observations import Evaluation
from understudy.trees.core.task_activity import TaskActive, task_timing

State = Literal["Healthy", "Starting", "Failed"]

STATUS: dict[State, Status] = {"Healthy": Status.SUCCESS, "Starting": Status.RUNNING, "Failed": Status.FAILURE}
"""The py_trees status of each state."""

STATE: dict[Status, State] = {status: state for state, status in STATUS.items()}
"""The state of each py_trees status."""

LONGEST_REASON = 1024
"""Most characters of a reason, without that of the leaf's task."""


@dataclass(frozen=True)
class LeafPlace:
    """The place of a leaf in a tree."""

    path: str
    evaluation: Evaluation
    """Provides its input."""
    tasks: Sequence[TaskActive] = ()
    """The tasks for which it is judged."""


class Leaf(Behaviour, ABC):
    """One condition about one topic of the evaluated instance.

    A leaf for a task is not judged while the task is not active. Its clocks start when the task becomes active at the
    earliest, and what it needs then has some time to start.
    """

    uses_messages = True
    """Whether it judges by the topic's messages."""
    kind = ""
    """Its key in the short form; the loader sets it."""
    blind = ""
    """Why the leaf itself cannot judge, in words; empty if it can. Such a leaf holds, because being unable to judge is
    not a failure."""
    of_cluster = False
    """Whether it needs observations of the cluster, because the ROS graph does not have them."""

    def __init__(self, place: LeafPlace, topic: str) -> None:
        super().__init__(place.path)
        self.topic = topic
        self.tasks = place.tasks
        self._evaluation = place.evaluation

    def update(self) -> Status:
        """Return the state at the time of the evaluation as a py_trees status."""
        state = self.state()
        if self._evaluation.real:
            if state == "Healthy":
                self.remember()
            if STATUS[state] != self.status or state == "Failed":
                self.feedback_message = self.reason(state)
        return STATUS[state]

    def counts(self) -> bool:
        """Return whether the leaf is judged now: always, unless it is for a task that is not active."""
        return not self.tasks or task_timing(self.tasks, self._evaluation) is not None

    @property
    def unrecorded(self) -> str:
        """Why the leaf cannot be evaluated from recorded messages, in words; empty if it can."""
        return "" if self.uses_messages else "it needs the live ROS graph, which a bag does not contain"

    def reason(self, state: State) -> str:
        """Return in plain words why the leaf is in this state. The text is the same for as long as nothing changes."""
        # It may quote a message of the robot, in which anything can be.
        reason = one_line(self._plain_reason(state), LONGEST_REASON)
        if self.tasks and state == "Failed":
            actions = " and of ".join(dict.fromkeys(task.action for task in self.tasks))
            return f"{reason} while a goal of {actions} is active"
        return reason

    def remember(self) -> None:
        """Note that the instance has been healthy by this leaf."""

    @abstractmethod
    def state(self) -> State:
        """Return the state at the time of the evaluation."""

    @abstractmethod
    def healthy_until(self) -> float | None:
        """Return when the leaf stops being healthy if nothing more arrives; None if it is not healthy at the time of
        the evaluation.

        It agrees with :meth:`state` but costs less, because every tick asks every leaf for it.
        """

    @abstractmethod
    def changes(self) -> list[float]:
        """Return the times after the evaluation at which the state may change without a further message."""

    @abstractmethod
    def last(self) -> float | None:
        """Return the last good time, in Unix seconds: when a message that shows it was received, or the task became
        active."""

    @abstractmethod
    def _plain_reason(self, state: State) -> str:
        """Return the reason without the leaf's task."""

    def _last_with_task(self, last: float | None) -> float | None:
        """Return the last good time: the later of the given time and the task's start."""
        if not self.tasks or (found := task_timing(self.tasks, self._evaluation)) is None:
            return last
        known = [time for time in (last, found.active) if time is not None and time >= self._evaluation.since]
        return max(known, default=None)

    def _nothing_received(self, state: State, what: str, within: float | None = None) -> str:
        """Return the reason if the instance has not sent ``what``, for example the first message of a topic, ``within`` seconds; by
        default, within the grace."""
        within = self._evaluation.grace if within is None else within
        if state == "Starting":
            return f"waiting for the first {what}, for up to {duration(within)}"
        if state == "Failed" and self.tasks:
            return f"no {what}"
        if state == "Failed":
            start = "the monitor's start" if self._evaluation.is_expected else "the start"
            return f"no {what} within {duration(within)} of {start}"
        return f"no {what} yet"


class IntervalLeaf(Leaf):
    """Fails during one interval, whose ends are known as long as nothing more arrives."""

    @abstractmethod
    def _failing(self) -> tuple[float, float] | None:
        """Return the interval in which the leaf fails if nothing more arrives; None if it does not fail."""

    def state(self) -> State:
        """Return the state at the time of the evaluation."""
        failing = self._failing()
        return "Failed" if failing is not None and failing[0] <= self._evaluation.now < failing[1] else "Healthy"

    def healthy_until(self) -> float | None:
        """Return when the leaf stops being healthy if nothing more arrives; None if it is not healthy."""
        failing = self._failing()
        if failing is None or self._evaluation.now >= failing[1]:
            return math.inf
        return failing[0] if self._evaluation.now < failing[0] else None

    def changes(self) -> list[float]:
        """Return the times after the evaluation at which the state may change without a further message."""
        return [moment for moment in self._failing() or () if self._evaluation.now < moment < math.inf]


def duration(seconds: float) -> str:
    """Format a length of time, such as ``500 ms`` or ``2 s``."""
    return f"{seconds * 1000:.6g} ms" if seconds < 1 else f"{seconds:.6g} s"
