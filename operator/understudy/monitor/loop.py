"""The monitor's loop: observe, judge, decide, act, report.

The loop wakes at deadlines, not at ticks: see understudy.monitor.observe.wakeups.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Collection
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.clock import CLOCK
from understudy.failover import switchover
from understudy.failover.decide import Activate, Decision, Hold, Recover, SwitchOver, Trigger, Wait
from understudy.failover.interfaces import NoLongerNeeded
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import StrategyContext
from understudy.failover.switchover import Preparation
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.recovery.pool_waiting import PoolQueue
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery.recovery_runner import ENDS
from understudy.monitor.act.stage import ActStage
from understudy.monitor.decide.initial_activation import Candidates
from understudy.monitor.decide.stage import DecideStage, Resolution
from understudy.monitor.judge.reassessment import fences_a_failure
from understudy.monitor.judge.sole_driver import PERIOD
from understudy.monitor.judge.stage import Judgement, JudgeStage
from understudy.monitor.notices import ConditionReport, Notices
from understudy.monitor.observe.objects import interrupted_recovery
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.stage import ObserveStage
from understudy.monitor.observe.wakeups import TICK, WAKE_LATE
from understudy.monitor.outcome import Outcome
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.stage import ReportStage

_logger = logging.getLogger(__name__)

SETTLE = 2.0
"""Maximum seconds that a new monitor waits for the agents of understudies before it begins or continues a recovery."""

SLOW = 1.0
"""Seconds between two rounds of work that is not urgent: standbys, whether the gate is enforced."""


@dataclass(frozen=True)
class Parts:
    """The parts that the loop works with."""

    cluster: Cluster
    senses: Senses
    state_manager: StateManager
    journal: RecoveryJournal
    black_box: BlackBox
    notices: Notices


class MonitorLoop:
    """Protects one workload."""

    def __init__(self, parts: Parts) -> None:
        cluster, senses, notices = parts.cluster, parts.senses, parts.notices
        self._view, self._pods, self._gate = cluster.view, cluster.pods, cluster.gate
        self._senses, self._observer, self._journal = senses, senses.observer, parts.journal
        self._notices, self._black_box = notices, parts.black_box
        context = StrategyContext(
            gate=cluster.gate,
            instances=cluster.pods,
            agents=senses.agents,
            outputs=senses.observer.outputs(cluster.pods, cluster.gate),
            queue=PoolQueue(cluster.view, notices),
            clock=CLOCK.now,
            save=parts.journal.save,
            workload_uid="",
            kept=lambda onset: parts.state_manager.select_for_recovery(CLOCK.to_system(onset)),
        )
        self.observe = ObserveStage(cluster.view, senses, notices)
        kept_from = parts.state_manager.source
        self.judge = JudgeStage(cluster.view, cluster.pods, cluster.gate, senses, kept_from, notices)
        self.decide = DecideStage(cluster.view, senses.agents, context, self.judge, self.observe.dependencies, notices)
        self.act = ActStage(cluster, senses, parts.state_manager, parts.journal, self.decide, notices)
        self.report = ReportStage(cluster, senses.observer, self.decide, self.act, notices)
        self._next_slow = 0.0
        self._new_until = -math.inf
        """Until when (monotonic seconds) the agent of an understudy may not be connected yet."""

    async def run(self) -> None:
        """Watch and recover until cancelled."""
        self._new_until = time.monotonic() + SETTLE
        async with self._ending_leaks():
            await self.resume()
        while True:
            resolution = await self._watch()
            async with self._ending_leaks():
                await self.carry_through(resolution)

    # -- observe, judge, decide -------------------------------------------------------------------------------------

    async def _watch(self) -> Resolution:
        """Evaluate at every deadline until a recovery, a hold or a switchover is decided. Returns the resolution."""
        schedule = self.observe.schedule
        schedule.restart()
        while True:
            now = schedule.begin()
            next_evaluation = now + TICK
            self.decide.limits.pauses.update(now)
            self.act.labels.follow()  # first, since a pod that vanished may have been unlabelled and not deleted
            policy = self._view.policy
            if policy is None or self._view.retired:
                self._notices.set(health="Unknown")
                next_evaluation = now + SLOW
            else:
                self._observe(policy, now)
                resolution = await self.evaluate(policy, now)
                if isinstance(resolution.decision, Recover | Hold | SwitchOver):
                    return resolution
                self.act.reflexes.guard()
                for deadline in (resolution.deadline, self.judge.takeover.next_check(time.time())):
                    if deadline is not None:
                        next_evaluation = min(next_evaluation, deadline + WAKE_LATE)
            if (clock := time.monotonic()) >= self._next_slow:  # unlike the clock of ``now``, this one is never set
                self._next_slow = clock + SLOW
                self._housekeeping()
            await schedule.until(next_evaluation)

    def _observe(self, policy: FailurePolicySpec, now: float) -> None:
        """Read the samples that have arrived, and the state of the workloads that this one depends on."""
        dependencies = self.observe.dependencies
        self.decide.limits.retries.update(self.decide.limits.spending.resumed, now)
        self._observer.follow(policy, self._view.spec)
        self.act.follow_safety(policy)
        dependencies.follow(self._view.settings)
        dependencies.update(now)
        self._drain()
        self.act.state_manager.take(policy.state, self._observer.addresses, self._gate.state.active)

    def _drain(self) -> None:
        state = self._gate.state
        self._observer.drain([*self._pods.of_workload(), *self.act.strays.instances], state.active, state.pinned)

    async def evaluate(self, policy: FailurePolicySpec, now: float) -> Resolution:
        """Judge and decide once. ``now`` is in Unix seconds."""
        if not self._gate.exists:
            self._notices.set(health="Unknown")
            return Resolution(Wait("NoGate"))
        paused = self.decide.limits.pauses.on is not None
        if paused or self.act.state_manager.adopted_nothing:
            # The user who paused decides about the instance; and without state to restore, a healthy one is not replaced.
            self.judge.unseen_restart.ignore()
        if not paused:
            await self.act.restore_routing()
        judgement = self.judge.judge(policy, now, self.observe.schedule.trusted_from)
        self.report.judged(judgement)
        self.decide.judged(judgement)
        self.act.judged(judgement)
        if not paused and await self.act.leaks.respond(policy, now):
            return Resolution(Wait("GateClosed"))
        prepared = self._prepared_switchover(judgement)
        other = self._recovery_of_another()
        may_continue = other is not None and self.observe.other_monitors.may_continue(other)
        resolution = self.decide.decide(policy, judgement, prepared, other, may_continue=may_continue)
        if resolution.candidates is not None:
            await self._while_closed(resolution.decision, resolution.candidates, now)
        return resolution

    def _recovery_of_another(self) -> Progress | None:
        """Return the recovery for which another monitor has closed the gate; None if there is none."""
        if not self._gate.state.closed:
            return None
        return interrupted_recovery.unconcluded(self._gate, self._notices.status, self.act.abandonment.ids)

    def _prepared_switchover(self, judgement: Judgement) -> Preparation | None:
        """Return the planned switchover that can be carried out now or whose outcome is still open."""
        if judgement.verdict is None or judgement.verdict.state == "Failed":
            return None
        if (unsettled := self.act.switchovers.unsettled()) is not None:
            return Preparation(unsettled)
        if self._view.settings is None:
            return None
        return self.act.switchovers.advance(self.decide.prevents_switchover(judgement))

    # -- act --------------------------------------------------------------------------------------------------------

    async def _while_closed(self, decision: Decision, candidates: Candidates, now: float) -> None:
        """Open the gate for the first candidate, or request a pod if none runs."""
        self.report.status_conditions.none_active(candidates, recovering=decision.reason == "RecoveryUnderWay")
        if decision.reason == "NoPodRunning":
            await self.act.opening.request_pod(now)
        elif decision.reason == "StillDriven":
            await self.act.opening.settle()
        elif isinstance(decision, Activate):
            await self.act.opening.open(candidates.first)
            self.judge.detector.watch()  # also after a request without an answer, which may be carried out later

    async def resume(self) -> None:
        """Finish what another monitor began."""
        abandoned = self.act.abandonment.ids
        journal, gate = self._journal.journal, self._gate
        interrupted = interrupted_recovery.interrupted(journal, gate, self._notices.status, abandoned)
        if interrupted is not None:
            _logger.warning("finishing recovery %s, which another monitor began", interrupted.id)
            # First of all, so that what the record named when this was decided still counts.
            if interrupted.switchover is None and not await self._take_over(interrupted):
                return
            await self._senses.agents.settle(self._pods.of_workload(), SETTLE)
            if interrupted.switchover is None:
                await self._continue(interrupted)
            elif interrupted.result != "Running" or switchover.committed(interrupted, self.decide.options.context()):
                self.conclude(await self.act.switchovers.carry_out(Preparation(interrupted)))
        elif (done := interrupted_recovery.concluded(gate, self._notices.status)) is not None:
            self.decide.limits.retries.note(done)

    async def _continue(self, interrupted: Progress) -> None:
        """Continue a recovery that another monitor began, unless that has changed nothing yet and the instance is healthy again.

        An instance that was given up as too slow may drive by now. Then its attempt is continued.
        """
        policy, fenced = self._view.policy, None
        late = interrupted_recovery.late_attempt(self._gate, interrupted)
        if late is not None:
            fenced = late.target
        elif fences_a_failure(interrupted) and self._gate.would_fence(interrupted):
            fenced = interrupted.failed[0]
        if policy is not None and fenced is not None:
            self.act.get_ready(policy)
            if await self.judge.reassessment.hears(fenced, SETTLE):
                if late is None:
                    words = f"{fenced.name} has been healthy again since the monitor ended that wanted to fence it"
                    self.conclude(self.act.recoveries.abandoned(interrupted, NoLongerNeeded(words)))
                    return
                interrupted = late
        await self.carry_out(interrupted)

    async def _take_over(self, progress: Progress) -> bool:
        """Name this monitor as the one that carries out a recovery. Returns False if another writer was first, or an error ended it."""
        progress.monitor = self._view.me
        try:
            return await self._gate.take_over(progress)
        except ENDS as error:
            self.conclude(self.act.recoveries.abandoned(progress, error))
            return False

    async def carry_through(self, resolution: Resolution) -> None:
        """Carry out a recovery or a planned switchover that was decided on."""
        if resolution.decision.trigger is Trigger.INTERRUPTED_RECOVERY:
            await self.resume()
            return
        if resolution.switch is not None:
            self.conclude(await self.act.switchovers.carry_out(resolution.switch))
            return
        failure = resolution.failure
        assert failure is not None, "a recovery is for a failure, a hand-over or a recovered dependency"
        known = self._view.policy is not None and self._view.settings is not None
        if failure.planned and known and not await self.decide.confirm():
            return
        if failure.planned:
            self.judge.levels.handed_over()
        self.report.recovery.begins(failure)
        progress = self.act.start.begin(failure, resolution.first_strategy)
        if progress.taken_over is None and not progress.follows:
            await self._wait_for_agents({one.uid for one in progress.failed})
        await self.carry_out(progress)

    async def carry_out(self, progress: Progress) -> None:
        """Carry a recovery out once the limits allow it, unless there is nothing left to protect."""
        progress.monitor = self._view.me
        self._black_box.begin(progress)
        try:
            async with self.judge.reassessment.during(progress):
                outcome = await self._carried_out(progress)
        finally:
            self._black_box.end(progress)
        self.conclude(outcome)

    async def _carried_out(self, progress: Progress) -> Outcome | None:
        try:
            async with aclosing(self.act.deferral.until_allowed(progress)) as deferred:
                async for _ in deferred:
                    self._continue_other_work()
        except ENDS as error:
            return self.act.recoveries.abandoned(progress, error)
        policy = self._view.policy
        if policy is None or self._view.settings is None or self._view.retired:
            return None
        self.act.get_ready(policy)
        return await self.act.recoveries.carry_out(progress, policy)

    async def _wait_for_agents(self, failed: Collection[str]) -> None:
        """Let a new monitor connect to the agents before it chooses a strategy. Otherwise it would restart a pod
        although a standby is ready, because that standby's agent is not connected yet."""
        if (left := self._new_until - time.monotonic()) > 0:
            others = [i for i in self._pods.of_workload() if i.uid not in failed]
            await self._senses.agents.settle(others, left)

    # -- report, and conclude ---------------------------------------------------------------------------------------

    def conclude(self, outcome: Outcome | None) -> None:
        """Report the outcome of a recovery or a switchover, and let every stage remember it."""
        if outcome is None:
            return
        self.judge.unseen_restart.rest()
        if outcome.kind == "NoLongerNeeded":
            self.judge.detector.well()  # the instance is judged by what it has sent all the time
        else:
            self.judge.detector.restart(outcome.committed)
        if outcome.verified is not None:
            self.judge.sole_driver.verified(outcome.verified)
        if not outcome.concluded:
            self.report.recovery.abandoned(outcome)
        else:
            self._journal.crash_points.step("before record")
            recovery = self._notices.record(outcome.progress)
            self.observe.dependencies.note(outcome.progress.follows)
            self.act.state_manager.report_restored(recovery)
            text = self.report.recovery.concluded(outcome, recovery)
            if outcome.kind in ("SwitchedOver", "NotSwitchedOver"):
                self.act.switchovers.done(outcome.progress, f"{text}.")
        self.decide.conclude(outcome)
        self.act.conclude(outcome)

    def _continue_other_work(self) -> None:
        """Do the work that continues while a recovery is deferred."""
        if (policy := self._view.policy) is not None:
            self.act.follow_safety(policy)
        self._drain()
        self._housekeeping()

    @asynccontextmanager
    async def _ending_leaks(self) -> AsyncIterator[None]:
        """Judge and end leaks, and restore the gate and labels, also during a recovery: it may wait for long, for example for a pod."""
        ending = asyncio.create_task(self._end_leaks())
        try:
            yield
        finally:
            ending.cancel()

    async def _end_leaks(self) -> None:
        while True:
            await asyncio.sleep(PERIOD)  # first, since the last evaluation was just now and the recovery must not wait
            try:
                await self._end_leaks_now(time.time())
            except Exception:  # neither the recovery nor the next look ends with it
                _logger.exception("ending leaks during a recovery")

    async def _end_leaks_now(self, now: float) -> None:
        self.act.labels.follow()
        self._drain()
        self.judge.sole_driver.update(self._pods.of_workload(), now)
        self._report_enforcement(now)
        if self.decide.limits.pauses.on is None:
            self.act.leaks.respond_during(self._senses.current, now)
            self.act.raise_epoch()
            await self.act.restore_routing()
            if (progress := self._senses.current.progress) is not None:
                await self.act.restore_record(progress)

    def _report_enforcement(self, now: float) -> ConditionReport:
        """Report whether the gate is enforced, and return the report."""
        others = [i for i in self._pods.of_workload() if i.uid != self.act.switchovers.preparing]
        judged = self.judge.enforcement.judge(others, self.judge.sole_driver.passing(now))
        self.judge.enforcement.report(judged)
        return judged

    def _housekeeping(self) -> None:
        """Do the work that is not urgent. Returns at once."""
        self.act.keep_connected()
        judged = self._report_enforcement(time.time())
        policy, settings = self._view.policy, self._view.settings
        if policy is None or settings is None:
            return
        self.report.status_conditions.housekeeping()
        self.decide.limits.spending.report(time.time())
        paused = self.decide.limits.pauses.on is not None
        self.act.raise_epoch()
        self.act.supervise_standbys(policy, paused=paused)
        self.act.reflexes.keep(time.time(), enforced=judged, paused=paused)
        self.judge.sole_driver.report(time.time())
        self.act.strays.look(*self.judge.sole_driver.unknown(time.time()))
