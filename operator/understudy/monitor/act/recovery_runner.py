"""Carries out recoveries and planned switchovers, one at a time, by the protocols of understudy.failover."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import aiohttp

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover import reflex, switchover
from understudy.failover.interfaces import NotAvailable, Superseded
from understudy.failover.progress import Progress
from understudy.failover.protocol import Choice, recover
from understudy.failover.switchover import Prepared
from understudy.kube.client import ApiError
from understudy.monitor.act.held_recovery import Holding
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.act.recovery_outcome import Aftermath
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.notices import Notices
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.dependencies import following
from understudy.monitor.report.black_box import BlackBox

_logger = logging.getLogger(__name__)

REFLEX_WITHIN = 10.0
"""Seconds within which a standby that took over by the reflex must be seen to drive alone, once the gate names it."""


class Recoveries:
    """The recoveries of one workload."""

    def __init__(
        self,
        view: View,
        notices: Notices,
        keeping: StateKeeping,
        black_box: BlackBox,
        crash_points: CrashPoints,
        repertoire: Repertoire,
        switching: Switching,
        current: CurrentRecovery,
        holding: Holding,
        aftermath: Aftermath,
        get_ready: Callable[[FailurePolicySpec], None],
        give_up: Callable[[Progress], None],
    ) -> None:
        """``get_ready`` has by this policy what sees and is asked during a recovery: it may come before the first look.
        ``give_up`` has nobody go on with one, or take it to be under way.
        """
        self._view, self._notices, self._keeping = view, notices, keeping
        self._black_box, self._crash_points = black_box, crash_points
        self._repertoire, self._switching = repertoire, switching
        self._current, self._holding, self._aftermath = current, holding, aftermath
        self._get_ready, self._give_up = get_ready, give_up

    async def recover(self, progress: Progress) -> None:
        """Carry a recovery out once the limits allow it."""
        try:
            await self._holding.until_allowed(progress)
        except Superseded as reason:
            self._superseded(progress, reason)
        except (ApiError, aiohttp.ClientError, OSError) as error:
            self._stopped(progress, error)
        else:
            await self.carry_out(progress)

    async def carry_out(self, progress: Progress) -> None:
        """Carry a recovery out now, unless there is nothing left to protect."""
        policy = self._view.policy
        if policy is None or self._view.settings is None or self._view.retired:
            return
        with self._notices.recovering():
            await self._carry_out(progress, policy)

    async def _carry_out(self, progress: Progress, policy: FailurePolicySpec) -> None:
        self._get_ready(policy)
        self._notices.condition("Recovering", "True", progress.occasion, progress.reason)
        # Why, first: that it is so is told at once.
        self._notices.set(health="Recovering", failing_since=progress.moments.get("last_healthy"))
        try:
            async with self._keeping.recovering():
                done = await self._recovered(progress, self._repertoire.choices())
        except Superseded as reason:
            self._superseded(progress, reason)
            return
        except (ApiError, aiohttp.ClientError, OSError) as error:
            if progress.result != "Recovered":
                self._stopped(progress, error)
                return
            _logger.warning("the failed pod is not deleted yet: %s", error)
            done = progress
        self._crash_points.step("before record")
        self._aftermath.recovered(done, policy)

    def _superseded(self, progress: Progress, reason: Superseded) -> None:
        self._give_up(progress)
        self._aftermath.superseded(progress, reason)

    def _stopped(self, progress: Progress, error: Exception) -> None:
        # What is tried again is another recovery; by then whoever failed may be well again, or somebody else drive.
        self._give_up(progress)
        self._aftermath.stopped(progress, error)

    async def _recovered(self, progress: Progress, choices: Sequence[Choice]) -> Progress:
        means = self._repertoire.means()
        self._black_box.begin(progress)
        try:
            with self._current.during(progress):
                if progress.taken_over is not None:
                    await reflex.commit(progress, means)
                    choices = [Choice(reflex.ReflexFallback(), REFLEX_WITHIN), *choices]
                elif progress.follows and self._view.spec is not None:
                    choices = following(progress.follows, self._view.spec, choices)
                return await recover(progress, choices, means)
        finally:
            self._black_box.end(progress)

    async def hand_over(self, prepared: Prepared) -> None:
        """Switch to an understudy that can drive, as is planned; or see what came of a switch that was begun before."""
        progress, means = prepared.progress, self._repertoire.means()
        self._switching.switching(progress)
        _logger.warning("switchover (%s): %s", progress.switchover, progress.reason)
        try:
            with self._current.during(progress):
                async with self._keeping.recovering():
                    if progress.former is None:
                        await switchover.switch(prepared, means)
                    else:
                        await switchover.settle(progress, means)
        except (NotAvailable, Superseded, ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            if progress.result == "Running":
                reason = str(error) or f"the API server didn't answer within {switchover.COMMIT_WITHIN:g} s"
                _logger.warning("switchover %s given up: %s", progress.id, reason)
                self._switching.given_up(progress, reason)
                return
            _logger.warning("the former pod is not deleted yet: %r", error)
        self._crash_points.step("before record")
        self._aftermath.switched(progress)
