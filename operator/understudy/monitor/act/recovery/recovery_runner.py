"""Begins recoveries and carries them out, one at a time, with the protocol of understudy.failover."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import aiohttp

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.clock import CLOCK
from understudy.failover import reflex
from understudy.failover.interfaces import NoLongerNeeded, Superseded
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.kube.client import ApiError
from understudy.monitor.act.instances.garbage_collection import GarbageCollection
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.recovery.abandonment import Abandonment
from understudy.monitor.act.recovery.planned_switchover import PlannedSwitchovers
from understudy.monitor.decide.retry_backoff import RetryBackoff
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.judge.reflex_takeover import ReflexTakeover
from understudy.monitor.notices import Notices
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.objects import dependencies
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.dependencies import following
from understudy.monitor.outcome import Kind, Outcome

_logger = logging.getLogger(__name__)

REFLEX_WITHIN = 10.0
"""Seconds within which a standby that took over by the reflex must be seen to drive alone, after the gate opens for it."""

ENDS = (Superseded, NoLongerNeeded, ApiError, aiohttp.ClientError, OSError)
"""Errors that end a recovery before every strategy was tried: another writer of the gate, an instance that is healthy again, or an API
server that refuses or is away.
"""


class RecoveryStart:
    """Begins the recoveries of one workload."""

    def __init__(
        self,
        cluster: Cluster,
        switchovers: PlannedSwitchovers,
        garbage: GarbageCollection,
        retries: RetryBackoff,
        takeover: ReflexTakeover,
    ) -> None:
        self._view, self._gate = cluster.view, cluster.gate
        self._switchovers, self._garbage, self._retries = switchovers, garbage, retries
        self._takeover = takeover

    def begin(self, failure: Failure, first_strategy: int) -> Progress:
        """Return a new recovery, which starts with the strategy of this index."""
        progress = self._begun(failure, first_strategy).moved(-CLOCK.step())
        state = self._gate.state
        progress.open_at = None if state.closed else state.epoch
        return progress

    def _begun(self, failure: Failure, first_strategy: int) -> Progress:
        prepared = self._switchovers.failed(failure.reason)
        state = self._gate.state
        failed = [PodIdentity(name=state.active, uid=state.active_uid)] if not state.closed else []
        if failure.taken is not None:
            return reflex.begin(failure.taken, failed[0], self._takeover.deadline, self._takeover.switcher)
        if failure.follows and failed:
            if prepared is not None:
                self._garbage.add(prepared)
            onset, detected = failure.onset, failure.detected
            return dependencies.begin(failure.follows, failed[0], self._view.spec, onset=onset, detected=detected)
        progress = Progress.begin(
            failure.reason,
            last_healthy=failure.onset,
            detected=failure.detected,
            failed=[*failed, *self._garbage.failed()],
            planned=failure.planned,
        )
        progress.target = prepared
        self._retries.begin(failure, state.active_uid)
        progress.index = first_strategy
        return progress


class RecoveryRunner:
    """The recoveries of one workload."""

    def __init__(
        self,
        view: ClusterView,
        options: StrategyOptions,
        state_manager: StateManager,
        current: CurrentRecovery,
        abandonment: Abandonment,
        notices: Notices,
    ) -> None:
        self._view, self._options, self._state_manager = view, options, state_manager
        self._current, self._abandonment, self._notices = current, abandonment, notices

    async def carry_out(self, progress: Progress, policy: FailurePolicySpec) -> Outcome:
        """Carry out a recovery by a policy. An error that ends it early is not raised, but is in the outcome."""
        choices = self._options.choices()
        with self._notices.recovering(status_soon=_has_own_instance(progress, choices)):
            # The condition contains the reason, so it is set before the health.
            self._notices.condition("Recovering", "True", progress.occasion, progress.reason)
            self._notices.set(health="Recovering", failing_since=_failing_since(progress))
            try:
                async with self._state_manager.recovering():
                    done = await self._recovered(progress, choices)
            except ENDS as error:
                if isinstance(error, Superseded) or progress.result != "Recovered":
                    return self.abandoned(progress, error)
                _logger.warning("the failed pod is not deleted yet: %s", error)
                done = progress
            return Outcome("Recovered" if done.result == "Recovered" else "NothingVerified", done, policy)

    def abandoned(self, progress: Progress, error: Exception) -> Outcome:
        """Return the outcome of a recovery that an error ended. The next attempt is another recovery: by then the failed instance
        may be healthy again, or another one may be active.
        """
        self._abandonment.abandon(progress)
        kinds: dict[type[Exception], Kind] = {Superseded: "Superseded", NoLongerNeeded: "NoLongerNeeded"}
        return Outcome(kinds.get(type(error), "Stopped"), progress, error=error)

    async def _recovered(self, progress: Progress, choices: Sequence[Choice]) -> Progress:
        context = self._options.context()
        with self._current.during(progress):
            if progress.taken_over is not None:
                await reflex.commit(progress, context)
                choices = [Choice(reflex.ReflexFallback(), REFLEX_WITHIN), *choices]
            elif progress.follows and self._view.spec is not None:
                choices = following(progress.follows, self._view.spec, choices)
            return await recover(progress, choices, context)


def _has_own_instance(progress: Progress, choices: Sequence[Choice]) -> bool:
    """Return whether a standby of the workload takes over. Other recoveries make more commits and have no write to spare."""
    return progress.taken_over is not None or any(
        one.strategy.has_own_instance for one in choices[progress.index :][:1]
    )


def _failing_since(progress: Progress) -> float | None:
    last = progress.moments.get("last_healthy")
    return CLOCK.to_system(last) if last is not None else None
