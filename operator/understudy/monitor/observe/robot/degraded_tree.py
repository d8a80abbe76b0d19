"""The trees of ``spec.degraded``. They share the health tree's subscriptions, so that each topic is received only once."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

from understudy.api.base import seconds
from understudy.api.kinds.degraded_spec import Degraded, InlineTree
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.ros.runtime.interface_types import message_fields
from understudy.trees.core.health_tree import HealthTree, Verdict, WatchedTopic
from understudy.trees.core.observations import Observations
from understudy.trees.core.task_activity import STATUS_TYPE, TaskActive
from understudy.trees.languages.notations import load_inline
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)


class BusyReason(NamedTuple):
    """Why the robot does not count as idle."""

    kind: str
    """One word for the kind of reason, which stays the same while figures in ``words`` change."""
    words: str


class DegradedTrees:
    """The policy's trees that define when an instance is not degraded and when the robot is idle. If there are none,
    nothing is loaded, watched or judged."""

    def __init__(self) -> None:
        self._specification: tuple[Degraded | None, str, tuple[str, ...]] = (None, "", ())
        self._well: HealthTree | None = None
        self._idle: HealthTree | None = None
        self._tasks: tuple[TaskActive, ...] = ()
        self._blind: Collection[str] = ()
        self.problems: list[str] = []
        """The trees that do not load, and why."""

    def follow(self, policy: FailurePolicySpec, spec: RobotWorkloadSpec | None) -> bool:
        """Use the trees of this policy. Returns whether they changed. If a tree does not load, the last one stays in
        force."""
        degraded = policy.degraded
        reschedule = degraded.reschedule if degraded is not None else None
        actions = tuple(task.action for task in spec.tasks) if reschedule is not None and spec is not None else ()
        source = (degraded, policy.monitoring.startup_grace, actions)
        if self._specification == source:
            return False
        self._specification, self.problems = source, []
        self._tasks = tuple(TaskActive(action) for action in actions)
        grace = seconds(policy.monitoring.startup_grace)
        well = degraded.monitoring if degraded is not None else None
        self._well = self._loaded(well, self._well, "spec.degraded.monitoring", grace)
        index = next((i for i, one in enumerate(degraded.actions) if one.reschedule is not None), 0) if degraded else 0
        idle = reschedule.idle if reschedule is not None else None
        self._idle = self._loaded(idle, self._idle, f"spec.degraded.actions[{index}].reschedule.idle", grace)
        return True

    def _loaded(self, tree: InlineTree | None, last: HealthTree | None, path: str, grace: float) -> HealthTree | None:
        if tree is None:
            return None
        try:
            found = load_inline(tree, path=path, grace=grace, fields=message_fields)
        except TreeError as error:
            _logger.error("a tree of spec.degraded does not load; the last valid one stays in use: %s", error)
            self.problems.append(
                f"A tree of spec.degraded does not load. The monitor uses the last valid one until it is corrected: {error.in_short()}."
            )
            return last
        found.begin(time.time())
        return found

    @property
    def topics(self) -> list[WatchedTopic]:
        """The topics to watch; some may be listed more than once."""
        trees = [tree for tree in (self._well, self._idle) if tree is not None]
        statuses = [WatchedTopic(task.topic, STATUS_TYPE, 0.0, None, task=True) for task in self._tasks]
        # Degradation is not urgent: a message does not cause an evaluation.
        return [*(replace(topic, prompt=False) for tree in trees for topic in tree.topics), *statuses]

    def leave_out(self, topics: Collection[str]) -> None:
        """Judge without the leaves of topics that cannot be watched: missing data is no reason to act."""
        self._blind = topics
        if self._well is not None:
            self._well.leave_out(topics)

    def verdict(self, observations: Observations, *, now: float, since: float) -> Verdict:
        """Return the verdict on the instance that has been active since ``since``: Failed if it is degraded, Starting if
        that is unknown. Times are Unix seconds."""
        if self._well is None:
            return Verdict("Starting", "no tree of spec.degraded is loaded", "", None)
        return self._well.evaluate(observations, now=now, since=since)

    def busy(self, observations: Observations, *, now: float, since: float) -> BusyReason | None:
        """Return why the robot does not count as idle; None if it does. Missing data means that it is not idle."""
        for task in self._tasks:
            if observations.task(task.topic) is not None:
                return BusyReason("task", f"a goal of {task.action} is active")
        if self._idle is None:
            nothing = BusyReason(
                "never",
                "the workload has no tasks, and reschedule.idle of the policy does not define when the robot is idle",
            )
            return None if self._tasks else nothing
        if blind := [topic.name for topic in self._idle.topics if topic.name in self._blind]:
            return BusyReason("blind", f"{', '.join(blind)} cannot be watched")
        verdict = self._idle.evaluate(observations, now=now, since=since)
        return None if verdict.state == "Healthy" else BusyReason("idle", verdict.reason)
