"""The decide stage of one workload: decides what should happen now, by the table of precedence in
``failover/decide.py``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.decide import (
    FAILURES,
    Decision,
    Defer,
    Facts,
    Occurrence,
    Requirement,
    Trigger,
    Wait,
    considered,
    decide,
)
from understudy.failover.limits.state import ROBOT_AWAY, ActiveLimit
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import StrategyContext
from understudy.failover.switchover import Preparation
from understudy.monitor.decide.deferred_failures import DeferredFailures
from understudy.monitor.decide.initial_activation import Candidates, InitialActivation
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.recovery_of_another import RecoveryOfAnother
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.judge.stage import Judgement, JudgeStage
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.last_driver import last_driver
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.dependencies import Dependencies, describe
from understudy.monitor.outcome import Outcome


@dataclass(frozen=True)
class Resolution:
    """A decision, and the data that the act stage needs to carry it out."""

    decision: Decision
    failure: Failure | None = None
    """The cause of the recovery, if one is decided on or held."""
    first_strategy: int = 0
    """Index of the strategy to start with."""
    switch: Preparation | None = None
    """The prepared understudy, if a planned switchover is decided on; or the switchover whose outcome is still open."""
    candidates: Candidates | None = None
    """The pods that the gate may open for, while it is closed."""
    deadline: float | None = None
    """When to decide again at the latest (Unix seconds); None if the next tick is early enough."""


@dataclass(frozen=True)
class _Case:
    """A trigger that is present, and its cause."""

    occurrence: Occurrence
    failure: Failure | None = None
    switch: Preparation | None = None


class DecideStage:
    """Decides for one workload. Times are Unix seconds."""

    def __init__(
        self,
        view: ClusterView,
        agents: AgentConnections,
        context: StrategyContext,
        judge: JudgeStage,
        dependencies: Dependencies,
        notices: Notices,
    ) -> None:
        """``context`` lacks the settings and policy of the workload, which are added at each use."""
        self._view, self._gate, self._notices = view, context.gate, notices
        self._pods = context.instances
        self._levels, self._dependencies = judge.levels, dependencies
        self.takeover, self.sole_driver = judge.takeover, judge.sole_driver
        self.unseen_restart, self._enforcement = judge.unseen_restart, judge.enforcement
        self.limits = Limits(view, notices)
        self.options = StrategyOptions(view, self.limits.storms, context)
        self._deferred = DeferredFailures(notices)
        self._activation = InitialActivation(context.instances, agents)
        self._driver = ""
        """UID of the instance that the gate admitted last, as far as this monitor knows."""
        self._other = RecoveryOfAnother(self.options)

    def decide(
        self,
        policy: FailurePolicySpec,
        judgement: Judgement,
        prepared: Preparation | None,
        unconcluded: Progress | None = None,
        *,
        may_continue: bool = True,
    ) -> Resolution:
        """Return what to do now.

        ``prepared`` is the planned switchover that can be carried out or whose outcome is still open; ``unconcluded`` is the recovery in
        the gate's record, if it has not ended and this monitor does not carry it out; ``may_continue`` is whether another one may.
        """
        if self._gate.state.closed:
            other = self._other.occurrence(unconcluded, may_continue=may_continue)
            return self._activate(policy, judgement.now, other)
        self._driver = self._gate.state.active_uid
        cases = list(self._cases(policy, judgement, prepared))
        if not cases:
            return Resolution(Wait("NothingDue"), deadline=judgement.deadline)
        facts = self._facts(judgement, tuple(case.occurrence for case in cases))
        for one in considered(facts):
            if isinstance(one, Defer) and one.trigger is Trigger.DEGRADED:
                self._levels.wait(one.reason, one.message)
        decision = decide(facts)
        case = next(case for case in cases if case.occurrence.trigger is decision.trigger)
        self._note(decision, case.failure)
        deadlines = [moment for moment in (decision.deadline, judgement.deadline) if moment is not None]
        first = case.occurrence.first_strategy or 0
        return Resolution(decision, case.failure, first, case.switch, deadline=min(deadlines, default=None))

    def prevents_switchover(self, judgement: Judgement) -> str:
        """Return why no planned switchover may begin now; empty if one may."""
        unmet = None
        if judgement.verdict is not None and not judgement.healthy:
            why = judgement.verdict.reason or "it has just taken control"
            unmet = Requirement("NotHealthy", f"{self._gate.state.active} is not healthy yet ({why})")
        facts = self._facts(judgement, (Occurrence(Trigger.SWITCHOVER_REQUESTED, unmet=unmet),))
        decision = decide(facts)
        return decision.message if isinstance(decision, Defer) else ""

    async def confirm(self) -> bool:
        """Return whether the first strategy can run, according to the present state of the cluster and not only to reports."""
        if (lacking := await self.options.check_first()) is not None:
            found = _unavailable(lacking)
            self._levels.wait(found.reason, found.words)
        return lacking is None

    def judged(self, judgement: Judgement) -> None:
        """Note the judgement: the report about the next failure, and the first strategy of its recovery, depend on it."""
        if judgement.active is not None and judgement.verdict is not None and judgement.failure is None:
            self._dependencies.well(judgement.active.name)
        if judgement.healthy:
            self._deferred.healthy()
        if judgement.settled:
            self.limits.retries.healthy()

    def conclude(self, outcome: Outcome) -> None:
        """Remember the outcome of a recovery or a switchover."""
        self._deferred.conclude()
        self.limits.conclude(outcome)

    # -- what could happen now --------------------------------------------------------------------------------------

    def _activate(self, policy: FailurePolicySpec, now: float, other: Occurrence | None) -> Resolution:
        limits = self.limits.in_force(now)
        rightful = self.sole_driver.rightful or self._last_driver()
        candidates = self._activation.candidates(policy, now, paused=limits.pause is not None, rightful=rightful)
        unmet = candidates.unmet
        if unmet is None and policy.on_leak == "Close" and self.sole_driver.may_be_driven(now):
            unmet = Requirement("StillDriven")
        first = Occurrence(Trigger.INITIAL_ACTIVATION, unmet=unmet)
        facts = Facts(now, (first,) if other is None else (other, first), limits)
        return Resolution(decide(facts), candidates=candidates)

    def _last_driver(self) -> str:
        """Return the UID of the instance that drove until the gate was closed; empty if it has failed, or is not known.

        Somebody may have deleted the gate, and its list of drivers with it, or this monitor may be new.
        """
        state = self._gate.state
        known = last_driver(state, self._notices.status, self._pods.of_workload())
        driver = self._driver or (known.uid if known is not None else "")
        return "" if state.recovery is not None and state.recovery.has_failed(driver) else driver

    def _cases(self, policy: FailurePolicySpec, judgement: Judgement, prepared: Preparation | None) -> Iterator[_Case]:
        """Return every trigger that is present. ``failover/decide.py`` says which one comes first."""
        if judgement.failure is not None:
            yield self._failed(policy, judgement, self._since_pause(judgement.failure))
        verdict, active, now = judgement.verdict, judgement.active, judgement.now
        if verdict is None or active is None:
            return
        if verdict.state != "Starting" and (due := self._dependencies.due(active, now)) is not None:
            trigger, reason = Trigger.DEPENDENCY_RECOVERED, describe(due.follows)
            failure = Failure(reason, judgement.last_well, now, trigger, follows=due.follows)
            yield _Case(Occurrence(trigger, reason), failure)
        if prepared is not None:
            trigger = Trigger.SWITCHOVER_REQUESTED if prepared.target is not None else Trigger.UNSETTLED_SWITCHOVER
            yield _Case(Occurrence(trigger, prepared.progress.reason), switch=prepared)
        idle = self._levels.due if judgement.healthy and judgement.degraded else None
        if idle is not None and self._view.settings is not None:
            lacking = self.options.first_missing()
            unmet = _unavailable(lacking) if lacking is not None else None
            failure = Failure(idle, judgement.last_well, now, Trigger.DEGRADED)
            yield self._starting_with(failure, Occurrence(Trigger.DEGRADED, idle, unmet=unmet))

    def _failed(self, policy: FailurePolicySpec, judgement: Judgement, failure: Failure) -> _Case:
        occurrence = Occurrence(failure.trigger, failure.reason, counts_from=judgement.counts_from)
        if failure.trigger is Trigger.HEALTH_FAILED and judgement.now >= judgement.trusted_from:
            self._dependencies.notice(failure.onset, failure.detected)
            # With priority Safety, a failed instance does not stay active while a dependency recovers: it may do worse
            # than to be silent.
            if judgement.now >= judgement.counts_from and policy.priority != "Safety":
                again = self._dependencies.hold(failure.reason, failure.onset, judgement.now)
                occurrence = replace(occurrence, upstream=ActiveLimit(until=again) if again is not None else None)
        return self._starting_with(failure, occurrence)

    def _since_pause(self, failure: Failure) -> Failure:
        """Return the failure with its onset after the last pause: outputs that were missing during a pause are no failure."""
        if failure.trigger is Trigger.REFLEX_TAKEOVER:
            return failure
        return replace(failure, onset=max(failure.onset, min(self.limits.pauses.ended, failure.detected)))

    def _starting_with(self, failure: Failure, occurrence: Occurrence) -> _Case:
        """Return the case, with the strategy that a recovery would start with."""
        retries = self.limits.retries
        first = retries.first(failure.onset, self._gate.state.active_uid)
        return _Case(replace(occurrence, first_strategy=first, retry_after=retries.retry_after), failure)

    def _facts(self, judgement: Judgement, occurrences: tuple[Occurrence, ...]) -> Facts:
        limits = self.limits.in_force(judgement.now)
        if self._enforcement.robot_is_away:
            limits = replace(limits, away=ROBOT_AWAY)
        ready = limits.storm is not None and self.options.standby_ready()
        return Facts(judgement.now, occurrences, limits, standby_ready=ready, trusted_from=judgement.trusted_from)

    # -- reporting --------------------------------------------------------------------------------------------------

    def _note(self, decision: Decision, failure: Failure | None) -> None:
        if failure is None or isinstance(decision, Wait):
            return
        if failure.trigger in FAILURES:
            self._notices.set(health="Failed", failing_since=failure.onset)
        if not isinstance(decision, Defer):
            self._deferred.conclude()
        elif decision.reason == "CrashLooping":
            self.limits.retries.crash_looping(failure.reason)
            self._deferred.reported_wait()
        elif failure.trigger in FAILURES:
            self._deferred.report(decision, failure)


def _unavailable(lacking: str) -> Requirement:
    return Requirement("FirstStrategyUnavailable", f"the first strategy cannot run ({lacking})")
