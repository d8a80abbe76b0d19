"""Finds what is due although nothing has failed: the hand-over of a degraded instance, a requested switchover, and the reaction to the
recovery of a dependency. The limits apply to each of them as ``failover/decide.py`` says.
"""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.failover.decide import Defer, Facts, Occurrence, Requirement, Trigger, decide
from understudy.failover.interfaces import Instance
from understudy.failover.limits.state import LimitsInForce
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.degradation_level import Levels
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.dependencies import Dependencies
from understudy.trees.core.health_tree import Verdict


class Occasions:
    """The planned actions of one workload. Times are unix seconds."""

    def __init__(
        self, view: View, levels: Levels, dependencies: Dependencies, repertoire: Repertoire, limits: Limits
    ) -> None:
        self._view, self._levels, self._dependencies = view, levels, dependencies
        self._repertoire, self._limits = repertoire, limits

    def followed(self, active: Instance, now: float) -> Sequence[DependencyRecovery]:
        """Return the recoveries of dependencies after which something is due now for the active instance."""
        found = self._dependencies.due(active, now)
        if found is None or self._deferred(Occurrence(Trigger.DEPENDENCY_RECOVERED), now) is not None:
            return ()
        return found.follows

    def hand_over(self, now: float) -> str | None:
        """Return why the degraded instance is handed over now; None if that is not due. It does not wait for the first strategy."""
        if (reason := self._levels.due) is None or self._view.settings is None:
            return None
        limits = self._limits.in_force(now)
        deferred = self._deferred(Occurrence(Trigger.DEGRADED, reason), now, limits)
        if deferred is None and (lacking := self._repertoire.first_lacks()) is not None:
            deferred = self._deferred(Occurrence(Trigger.DEGRADED, reason, unmet=_unavailable(lacking)), now, limits)
        if deferred is not None:
            self._levels.wait(deferred.reason, deferred.message)
            return None
        return reason

    async def is_there(self) -> bool:
        """Return whether the first strategy can run by the present state of the cluster, not only by what was reported."""
        if (lacking := await self._repertoire.look_for_first()) is not None:
            found = _unavailable(lacking)
            self._levels.wait(found.reason, found.words)
        return lacking is None

    def defers_switchover(self, active: str, verdict: Verdict, now: float) -> str:
        """Return why no planned switchover may begin now; empty if one may. ``active`` is the name of the active instance."""
        unmet = None
        if verdict.state != "Healthy":
            why = verdict.reason or "it has just taken control"
            unmet = Requirement("NotHealthy", f"{active} is not healthy yet ({why})")
        deferred = self._deferred(Occurrence(Trigger.SWITCHOVER_REQUESTED, unmet=unmet), now)
        return deferred.message if deferred is not None else ""

    def _deferred(self, occurrence: Occurrence, now: float, limits: LimitsInForce | None = None) -> Defer | None:
        limits = limits or self._limits.in_force(now)
        ready = limits.storm is not None and self._repertoire.stands_by()
        decision = decide(Facts(now, (occurrence,), limits, standby_ready=ready))
        return decision if isinstance(decision, Defer) else None


def _unavailable(lacking: str) -> Requirement:
    return Requirement("FirstStrategyUnavailable", f"the first strategy cannot run ({lacking})")
