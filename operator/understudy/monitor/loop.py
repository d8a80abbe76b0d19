"""The monitor's loop: observe, judge, decide, act, report.

The loop wakes at deadlines, not at ticks: see understudy.monitor.observe.wakeups.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Collection
from contextlib import aclosing
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover import switchover
from understudy.failover.interfaces import Instance
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import Means
from understudy.failover.switchover import Prepared
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.act.pool_waiting import Line
from understudy.monitor.act.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery_runner import ENDS
from understudy.monitor.act.stage import ActStage
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.decide.stage import DecideStage
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.judge.stage import JudgeStage
from understudy.monitor.notices import FailureDetected, Notices
from understudy.monitor.observe import interrupted_recovery
from understudy.monitor.observe.dependencies import told
from understudy.monitor.observe.senses import Senses
from understudy.monitor.observe.stage import ObserveStage
from understudy.monitor.observe.wakeups import TICK, WAKE_LATE
from understudy.monitor.outcome import Outcome
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.stage import ReportStage
from understudy.trees.core.health_tree import Verdict

_logger = logging.getLogger(__name__)

SETTLE = 2.0
"""Maximum seconds that a new monitor waits for the agents of understudies before it begins or continues a recovery."""

SLOW = 1.0
"""Seconds between looks at what is not urgent: labels, standbys, whether the gate is enforced."""


@dataclass(frozen=True)
class Parts:
    """What the loop works with."""

    cluster: Cluster
    senses: Senses
    keeping: StateKeeping
    journal: RecoveryJournal
    black_box: BlackBox
    notices: Notices


class Supervisor:
    """Protects one workload."""

    def __init__(self, parts: Parts) -> None:
        cluster, senses, notices = parts.cluster, parts.senses, parts.notices
        self._view, self._pods, self._gate = cluster.view, cluster.pods, cluster.gate
        self._senses, self._sight, self._journal = senses, senses.sight, parts.journal
        self._notices, self._black_box = notices, parts.black_box
        means = Means(
            gate=cluster.gate,
            instances=cluster.pods,
            agents=senses.sidecars,
            outputs=senses.sight.outputs(cluster.pods, cluster.gate),
            queue=Line(cluster.view, notices),
            clock=time.time,
            save=parts.journal.save,
            workload_uid="",
            kept=parts.keeping.select,
        )
        self.observe = ObserveStage(cluster.view, senses, notices)
        self.judge = JudgeStage(cluster.pods, cluster.gate, senses, notices)
        self.decide = DecideStage(cluster.view, senses.sidecars, means, self.judge, self.observe.dependencies, notices)
        self.act = ActStage(cluster, senses, parts.keeping, parts.journal, self.decide, notices)
        self.report = ReportStage(cluster.view, cluster.gate, senses.sight, self.decide, self.act, notices)
        self._next_slow = 0.0
        self._new_until = -math.inf
        """Until when (monotonic seconds) an understudy may be there whose agent is not connected yet."""

    async def run(self) -> None:
        """Watch and recover until cancelled."""
        self._new_until = time.monotonic() + SETTLE
        await self.resume()
        while True:
            failure = await self._watch()
            await self.recover(failure)

    # -- observe, judge, decide -------------------------------------------------------------------------------------

    async def _watch(self) -> Failure:
        """Look at every deadline until there is something to do."""
        looks = self.observe.looks
        looks.restart()
        while True:
            now = looks.begin()
            next_look = now + TICK
            self.decide.limits.pauses.look(now)
            policy = self._view.policy
            if policy is None or self._view.retired:
                self._notices.set(health="Unknown")
                next_look = now + SLOW
            else:
                self._take_in(policy, now)
                failure, deadline = await self.look(policy, now)
                if failure is not None:
                    return failure
                if deadline is not None:
                    next_look = min(next_look, deadline + WAKE_LATE)
                self.act.reflexes.guard()
                if (again := self.act.reflexes.next_look(time.time())) is not None:
                    next_look = min(next_look, again)
            if (clock := time.monotonic()) >= self._next_slow:  # unlike the other clock it is never set
                self._next_slow = clock + SLOW
                self._housekeeping()
            await looks.until(next_look)

    def _take_in(self, policy: FailurePolicySpec, now: float) -> None:
        """Observe: what has arrived, and how the workloads are that this one depends on."""
        dependencies, active = self.observe.dependencies, self._gate.state.active
        self.decide.limits.retries.look(self.decide.limits.spending.resumed, now)
        self._sight.follow(policy, self._view.spec)
        self.act.follow_safety(policy)
        dependencies.follow(self._view.settings)
        dependencies.look(now)
        self._sight.drain(self._pods.of_workload(), active)
        self.act.keeping.take(policy.state, self._sight.addresses, active)

    async def look(self, policy: FailurePolicySpec, now: float) -> tuple[Failure | None, float | None]:
        """Return what to do now, or else when to look again at the latest (Unix seconds; None for the next tick)."""
        state, detector, trusted_from = self._gate.state, self.judge.detector, self.observe.looks.trusted_from
        if not self._gate.exists:
            self._notices.set(health="Unknown")
            return None, None
        self.judge.enforcement.look(now)
        if state.closed:
            if await self.decide.opening.look(policy, now):
                detector.watch()
            return None, None
        active = self._pods.find(state.active_uid)
        if (taken := self.act.reflexes.taken_over(now)) is not None:
            if now < trusted_from:
                return None, trusted_from
            reason = f"{state.active} is silent and {taken.standby.name} has taken over"
            return Failure(reason, taken.last, taken.first, taken), None
        if (loss := detector.lost(active, now)) is not None:
            failure, again = loss
            return (self.admit(failure, now) if failure else None), again
        assert active is not None
        verdict = detector.verdict(active, now)
        degraded = self.judge.levels.look(policy, verdict, active, now=now, since=detector.since)
        self.judge.situations.look(policy, verdict, now=now, since=detector.since)
        self.report.saying.health(verdict, degraded=degraded)
        self.act.keeping.judge(verdict.state, now)
        if verdict.state != "Starting" and (follows := self.decide.occasions.followed(active, now)):
            onset = detector.onset(active.name, now)
            return Failure(told(follows), onset, time.time(), follows=follows), None
        if verdict.state != "Failed":
            return self._look_at_working(policy, verdict, active, degraded=degraded, now=now)
        return self._look_at_failing(policy, verdict, active, now)

    def _look_at_working(
        self, policy: FailurePolicySpec, verdict: Verdict, active: Instance, *, degraded: bool, now: float
    ) -> tuple[Failure | None, float | None]:
        detector, limits, occasions = self.judge.detector, self.decide.limits, self.decide.occasions
        healthy = verdict.state == "Healthy"
        detector.well()
        self.observe.dependencies.well(active.name)
        if healthy:
            self.act.unattended.driven()
            self.decide.postponing.healthy()
        if healthy and now - detector.since >= seconds(policy.limits.healthy_delay):
            limits.retries.healthy()
            if self._notices.status.reason("Recovering") not in ("", "Recovered", "HealthyAgain"):
                self._notices.condition("Recovering", "False", "HealthyAgain", f"{active.name} is healthy again.")
        if (switch := self._planned_switchover(verdict, now)) is not None:
            return Failure(switch.progress.reason, now, now, switch=switch), None
        if healthy and degraded and (reason := occasions.hand_over(now)) is not None:
            return Failure(reason, detector.onset(active.name, now), time.time(), planned=True), None
        return None, self._sight.deadline(now=now, since=detector.since)

    def _planned_switchover(self, verdict: Verdict, now: float) -> Prepared | None:
        """Return the planned switchover that can be carried out now, or is not settled yet."""
        if (unsettled := self.act.switchovers.unsettled()) is not None:
            return Prepared(unsettled)
        if self._view.settings is None:
            return None
        lacking = self.decide.occasions.defers_switchover(self._gate.state.active, verdict, now)
        return self.act.switchovers.look(lacking)

    def _look_at_failing(
        self, policy: FailurePolicySpec, verdict: Verdict, active: Instance, now: float
    ) -> tuple[Failure | None, float | None]:
        dependencies, detected, trusted_from = self.observe.dependencies, time.time(), self.observe.looks.trusted_from
        if detected < trusted_from:
            return None, trusted_from
        onset = verdict.onset if verdict.onset is not None else self.judge.detector.onset(active.name, now)
        dependencies.notice(onset, detected)
        counts = self.judge.detector.counts_from(detected, policy.monitoring)
        if detected < counts:
            return None, counts
        # What is critical to safety is not left in control for another's sake: it may do worse than to be silent.
        urgent = policy.priority == "Safety"
        if not urgent and (again := dependencies.hold(verdict.reason, onset, now)) is not None:
            return None, again
        return self.admit(Failure(verdict.reason, onset, detected), now), None

    def admit(self, failure: Failure, now: float) -> Failure | None:
        """Return the failure, unless the limits defer it."""
        self.act.keeping.judge("Failed", now)
        self._notices.set(health="Failed", failing_since=failure.onset)
        return self.decide.postponing.admit(failure, now)

    # -- act --------------------------------------------------------------------------------------------------------

    async def resume(self) -> None:
        """Finish what an earlier monitor began."""
        abandoned = self.act.abandonment.ids
        journal, gate = self._journal.journal, self._gate
        interrupted = interrupted_recovery.interrupted(journal, gate, self._notices.status, abandoned)
        if interrupted is not None:
            _logger.warning("finishing recovery %s, which an earlier monitor began", interrupted.id)
            await self._senses.sidecars.settle(self._pods.of_workload(), SETTLE)
            if interrupted.switchover is None:
                await self.carry_out(interrupted)
            elif interrupted.result != "Running" or switchover.committed(interrupted, self.decide.repertoire.means()):
                self.conclude(await self.act.switchovers.carry_out(Prepared(interrupted)))
        elif (done := interrupted_recovery.concluded(gate, self._notices.status)) is not None:
            self.decide.limits.retries.note(done)

    async def recover(self, failure: Failure) -> None:
        """Recover from a failure, or carry out what is due without one."""
        if failure.switch is not None:
            self.conclude(await self.act.switchovers.carry_out(failure.switch))
            return
        known = self._view.policy is not None and self._view.settings is not None
        if failure.planned and known and not await self.decide.occasions.is_there():
            return
        what = "hand-over" if failure.planned else "dependency" if failure.follows else "failure"
        if failure.planned:
            self.judge.levels.handed_over()
            self._notices.event("Normal", "Rescheduling", failure.reason)
        elif failure.follows:
            self._notices.event("Normal", "FollowsDependency", failure.reason)
        else:
            self._notices.add(FailureDetected(time.time() - failure.detected))
        _logger.warning("%s of %s: %s", what, self._gate.state.active, failure.reason)
        progress = self.act.start.begin(failure)
        if progress is None:
            self.decide.postponing.told_to_wait()
            return
        if progress.taken_over is None and not progress.follows:
            await self._hear({one.uid for one in progress.failed})
        await self.carry_out(progress)

    async def carry_out(self, progress: Progress) -> None:
        """Carry a recovery out once the limits allow it, unless there is nothing left to protect."""
        self._black_box.begin(progress)
        try:
            outcome = await self._carried_out(progress)
        finally:
            self._black_box.end(progress)
        self.conclude(outcome)

    async def _carried_out(self, progress: Progress) -> Outcome | None:
        try:
            async with aclosing(self.act.deferral.until_allowed(progress)) as deferred:
                async for _ in deferred:
                    self._meanwhile()
        except ENDS as error:
            return self.act.recoveries.abandoned(progress, error)
        policy = self._view.policy
        if policy is None or self._view.settings is None or self._view.retired:
            return None
        self.act.get_ready(policy)
        return await self.act.recoveries.carry_out(progress, policy)

    async def _hear(self, failed: Collection[str]) -> None:
        """Have a new monitor hear of the understudies before it chooses: a warm one without a connection yet is no reason to restart."""
        if (left := self._new_until - time.monotonic()) > 0:
            others = [i for i in self._pods.of_workload() if i.uid not in failed]
            await self._senses.sidecars.settle(others, left)

    # -- report, and what every stage remembers ---------------------------------------------------------------------

    def conclude(self, outcome: Outcome | None) -> None:
        """Report the outcome of a recovery or a switchover, and let every stage remember it."""
        if outcome is None:
            return
        self.judge.detector.restart(outcome.committed)
        self.decide.postponing.conclude()
        if not outcome.concluded:
            self.report.recovery.abandoned(outcome)
        else:
            self._journal.crash_points.step("before record")
            recovery = self._notices.record(outcome.progress)
            self.observe.dependencies.note(outcome.progress.follows)
            self.act.keeping.tell(recovery)
            text = self.report.recovery.concluded(outcome, recovery)
            if outcome.kind in ("SwitchedOver", "NotSwitchedOver"):
                self.act.switchovers.done(outcome.progress, f"{text}.")
        self.decide.limits.conclude(outcome)
        self.act.conclude(outcome)

    def _meanwhile(self) -> None:
        """Do the work that continues while a recovery is deferred."""
        if (policy := self._view.policy) is not None:
            self.act.follow_safety(policy)
        self._sight.drain(self._pods.of_workload(), "")
        self._housekeeping()

    def _housekeeping(self) -> None:
        """Do what is not urgent. Returns at once."""
        self.act.keep_connected()
        policy, settings = self._view.policy, self._view.settings
        if policy is None or settings is None:
            return
        self.report.saying.housekeeping()
        self.decide.limits.spending.say(time.time())
        paused = self.decide.limits.pauses.on is not None
        self.act.care_for_standbys(policy, paused=paused)
        others = [i for i in self._pods.of_workload() if i.uid != self.act.switchovers.preparing]
        judged = self.judge.enforcement.judge(others)
        self.act.reflexes.keep(time.time(), enforced=judged[0] == "True", paused=paused)
        self.judge.enforcement.say(judged)
