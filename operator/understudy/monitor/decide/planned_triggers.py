"""What is due though nothing has failed: a hand-over of an instance that is degraded, a switchover that is asked for, and what others'
recoveries ask for.
"""

from __future__ import annotations

import time

from understudy.failover.interfaces import Gate, Instance
from understudy.failover.switchover import Prepared
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.degradation_level import Levels
from understudy.monitor.judge.failure_detection import Detector, Failure
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.dependencies import Dependencies, told
from understudy.trees.core.health_tree import Verdict

SOON_AFTER = "the policy's limits ask for a pause after the last recovery"


class Occasions:
    """Finds what is due for one workload, unless its limits say not now. Times are unix seconds."""

    def __init__(
        self,
        view: View,
        gate: Gate,
        detector: Detector,
        levels: Levels,
        switching: Switching,
        dependencies: Dependencies,
        repertoire: Repertoire,
        limits: Limits,
    ) -> None:
        self._view, self._gate, self._detector = view, gate, detector
        self._levels, self._switching, self._dependencies = levels, switching, dependencies
        self._repertoire, self._limits = repertoire, limits

    def followed(self, active: Instance, now: float) -> Failure | None:
        """What is to be done with the instance in control since others were recovered, if it is due."""
        found = self._dependencies.due(active, now)
        if found is None or now < self._limits.retries.not_before or self._limits.pauses.on is not None:
            return None
        onset = self._detector.onset(active.name, now)
        return Failure(told(found.follows), onset, time.time(), follows=found.follows)

    def hand_over(self, active: Instance, now: float) -> Failure | None:
        """The hand-over of a degraded instance, if it is due. The policy's first strategy must be there: nobody waits for it."""
        if (reason := self._levels.due) is None or self._view.settings is None:
            return None
        if self._limits.pauses.on is not None:
            self._levels.wait("paused", f"it is {self._limits.pauses.on.words}")
            return None
        if now < self._limits.retries.not_before:
            self._levels.wait("limits", SOON_AFTER)
            return None
        if self._limits.spending.spent_until(now) is not None:
            self._levels.wait("budget", "the budget of the policy is spent, see WithinBudget")
            return None
        if (lacking := self._repertoire.first_lacks()) is not None:
            self._wait(lacking)
            return None
        return Failure(reason, self._detector.onset(active.name, now), time.time(), planned=True)

    async def is_there(self) -> bool:
        """Whether what a hand-over that is due needs is there by what is so, and not only by what was said."""
        if (lacking := await self._repertoire.look_for_first()) is not None:
            self._wait(lacking)
        return lacking is None

    def _wait(self, lacking: str) -> None:
        self._levels.wait("means", f"the first strategy can't be carried out ({lacking})")

    def switchover(self, verdict: Verdict, now: float) -> Failure | None:
        """The planned switchover that can be carried out now, if there is one."""
        if (unsettled := self._switching.unsettled()) is not None:
            return Failure(unsettled.reason, now, now, switch=Prepared(unsettled))
        if self._view.settings is None:
            return None
        lacking = ""
        if (pause := self._limits.pauses.on) is not None:
            lacking = f"it is {pause.words}"
        elif verdict.state != "Healthy":
            lacking = f"{self._gate.state.active} isn't healthy yet ({verdict.reason or 'it has just begun to drive'})"
        elif now < self._limits.retries.not_before:
            lacking = SOON_AFTER
        elif (storm := self._limits.storms.on(now)) is not None and not self._repertoire.stands_by():
            lacking = f"others fail: {storm}"
        found = self._switching.look(lacking, self._repertoire.choices, self._repertoire.means)
        return Failure(found.progress.reason, now, now, switch=found) if found is not None else None
