"""Finds what is due although nothing has failed: the hand-over of a degraded instance, a requested switchover, and the reaction to the
recovery of a dependency. The limits apply to each of them as ``failover/decide.py`` says.
"""

from __future__ import annotations

import time

from understudy.failover.decide import Defer, Facts, Occurrence, Requirement, Trigger, decide
from understudy.failover.interfaces import Gate, Instance
from understudy.failover.limits.state import LimitsInForce
from understudy.failover.switchover import Prepared
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.degradation_level import Levels
from understudy.monitor.judge.failure_detection import Detector, Failure
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.dependencies import Dependencies, told
from understudy.trees.core.health_tree import Verdict


class Occasions:
    """The planned actions of one workload. Times are unix seconds."""

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
        """Return the reaction to the recovery of dependencies, if it is due now."""
        found = self._dependencies.due(active, now)
        if found is None or self._deferred(Occurrence(Trigger.DEPENDENCY_RECOVERED), now) is not None:
            return None
        onset = self._detector.onset(active.name, now)
        return Failure(told(found.follows), onset, time.time(), follows=found.follows)

    def hand_over(self, active: Instance, now: float) -> Failure | None:
        """Return the hand-over of a degraded instance, if it is due now. It does not wait for the policy's first strategy."""
        if (reason := self._levels.due) is None or self._view.settings is None:
            return None
        limits = self._limits.in_force(now)
        deferred = self._deferred(Occurrence(Trigger.DEGRADED, reason), now, limits)
        if deferred is None and (lacking := self._repertoire.first_lacks()) is not None:
            deferred = self._deferred(Occurrence(Trigger.DEGRADED, reason, unmet=_unavailable(lacking)), now, limits)
        if deferred is not None:
            self._levels.wait(deferred.reason, deferred.message)
            return None
        return Failure(reason, self._detector.onset(active.name, now), time.time(), planned=True)

    async def is_there(self) -> bool:
        """Return whether the first strategy can run by the present state of the cluster, not only by what was reported."""
        if (lacking := await self._repertoire.look_for_first()) is not None:
            found = _unavailable(lacking)
            self._levels.wait(found.reason, found.words)
        return lacking is None

    def switchover(self, verdict: Verdict, now: float) -> Failure | None:
        """Return the planned switchover that can be carried out now, if there is one."""
        if (unsettled := self._switching.unsettled()) is not None:
            return Failure(unsettled.reason, now, now, switch=Prepared(unsettled))
        if self._view.settings is None:
            return None
        unmet = None
        if verdict.state != "Healthy":
            why = verdict.reason or "it has just taken control"
            unmet = Requirement("NotHealthy", f"{self._gate.state.active} is not healthy yet ({why})")
        deferred = self._deferred(Occurrence(Trigger.SWITCHOVER_REQUESTED, unmet=unmet), now)
        lacking = deferred.message if deferred is not None else ""
        found = self._switching.look(lacking, self._repertoire.choices, self._repertoire.means)
        return Failure(found.progress.reason, now, now, switch=found) if found is not None else None

    def _deferred(self, occurrence: Occurrence, now: float, limits: LimitsInForce | None = None) -> Defer | None:
        limits = limits or self._limits.in_force(now)
        ready = limits.storm is not None and self._repertoire.stands_by()
        decision = decide(Facts(now, (occurrence,), limits, standby_ready=ready))
        return decision if isinstance(decision, Defer) else None


def _unavailable(lacking: str) -> Requirement:
    return Requirement("FirstStrategyUnavailable", f"the first strategy cannot run ({lacking})")
