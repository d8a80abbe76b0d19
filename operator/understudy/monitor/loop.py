"""The monitor's loop: watch until the workload fails, recover, report, watch again.

When it looks is decided in wakeups.py.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover import reflex, switchover
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Means
from understudy.failover.switchover import Prepared
from understudy.kube.gates.base import Proof
from understudy.monitor.act.abandonment import GivingUp
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.act.garbage_collection import Leftovers
from understudy.monitor.act.held_recovery import Holding
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.act.pod_labels import Labels
from understudy.monitor.act.pool_waiting import Line
from understudy.monitor.act.recovery_outcome import Aftermath
from understudy.monitor.act.recovery_runner import Recoveries
from understudy.monitor.act.reflex_guard import Reflexes
from understudy.monitor.act.safe_commands import SafeCommands, Unattended
from understudy.monitor.act.standby_supervision import Standbys
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.decide.deferred_failures import Postponing
from understudy.monitor.decide.initial_activation import Opening
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.planned_triggers import Occasions
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.degradation_level import Levels
from understudy.monitor.judge.failure_detection import Detector, Failure
from understudy.monitor.judge.gate_enforcement import Enforcement
from understudy.monitor.judge.situation_tracking import Situations
from understudy.monitor.notices import FailureDetected, Notices
from understudy.monitor.observe import interrupted_recovery
from understudy.monitor.observe.agent_connections import Sidecars
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.dependencies import Dependencies
from understudy.monitor.observe.health_observer import Sight
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.wakeups import TICK, WAKE_LATE, Looks, Wakeups
from understudy.monitor.report.black_box import BlackBox
from understudy.monitor.report.status_conditions import Saying

_logger = logging.getLogger(__name__)

SETTLE = 2.0
"""Most seconds that a new monitor takes to hear of the understudies before it goes on with a recovery, or begins one."""

SLOW = 1.0
"""Seconds between looks at what isn't urgent: labels, whether the gate is enforced."""


@dataclass
class Parts:
    """What the supervisor works with."""

    wakeups: Wakeups
    cluster: Cluster
    current: CurrentRecovery
    roles: InstanceRoles
    sidecars: Sidecars
    sight: Sight
    probes: Proof
    notices: Notices
    journal: Journal
    crash_points: CrashPoints
    keeping: StateKeeping
    black_box: BlackBox
    ungated: Callable[[], str] = str
    """Tells of readers of the robot that the gate doesn't reach; empty for none."""


class Supervisor:
    """Protects one workload."""

    def __init__(self, parts: Parts) -> None:
        cluster, roles = parts.cluster, parts.roles
        self._view, self._fleet, self._gate = view, fleet, gate = cluster.view, cluster.pods, cluster.gate
        self._sidecars, self._sight = sidecars, sight = parts.sidecars, parts.sight
        self._notices, self._keeping = notices, keeping = parts.notices, parts.keeping
        self._journal, self._crash_points = parts.journal, parts.crash_points
        self._next_slow = 0.0
        self._new_until = -math.inf
        """Until when (monotonic seconds) an understudy that nobody has heard of yet may well be there."""
        self.looks = Looks(parts.wakeups, sight.coming)
        self._detector = detector = Detector(fleet, gate, sidecars, sight)
        self._current = current = parts.current
        self._unattended = unattended = Unattended()
        self._limits = limits = Limits(view, notices)
        self._line = Line(view, notices)
        self._repertoire = repertoire = Repertoire(view, limits.storms, self._means)
        self._postponing = postponing = Postponing(notices, limits, repertoire)
        self._dependencies = dependencies = Dependencies(view, notices, parts.wakeups)
        self._leftovers = leftovers = Leftovers(fleet, gate, notices)
        self._switching = switching = Switching(view, fleet, gate, notices, leftovers)
        self._levels = levels = Levels(sight, notices)
        self._situations = Situations(sight, notices)
        self._occasions = Occasions(view, gate, detector, levels, switching, dependencies, repertoire, limits)
        self._safety = SafeCommands(sight.graph, self._waited_since)
        self._saying = Saying(view, gate, sight, self._safety, repertoire, notices)
        self._opening = Opening(fleet, gate, sidecars, notices, limits.pauses)
        self._labels = Labels(fleet)
        self._standbys = Standbys(cluster, sidecars, roles, current, keeping, notices)
        self._giving_up = GivingUp(gate, parts.journal, notices)
        self._enforcement = Enforcement(gate, parts.probes, notices, parts.ungated)
        self._reflexes = Reflexes(view, fleet, gate, sidecars, sight, parts.probes, notices)
        holding = Holding(view, gate, notices, parts.black_box, limits, current, self._save, self._meanwhile)
        aftermath = Aftermath(
            gate, notices, keeping, detector, limits, postponing, unattended, dependencies, leftovers, switching
        )
        self._recoveries = Recoveries(
            view,
            notices,
            keeping,
            parts.black_box,
            parts.crash_points,
            repertoire,
            switching,
            current,
            holding,
            aftermath,
            self._get_ready,
            self._give_up,
        )

    async def run(self) -> None:
        """Watch and recover until cancelled."""
        self._new_until = time.monotonic() + SETTLE
        await self._resume()
        while True:
            await self._act_on(await self._watch())

    async def _resume(self) -> None:
        """Go on with what an earlier monitor had begun."""
        interrupted = interrupted_recovery.interrupted(
            self._journal, self._gate, self._notices.status, self._giving_up.ids
        )
        if interrupted is not None:
            _logger.warning("finishing recovery %s, begun before this monitor started", interrupted.id)
            await self._sidecars.settle(self._fleet.of_workload(), SETTLE)
            if interrupted.switchover is None:
                await self._recoveries.recover(interrupted)
            elif interrupted.result != "Running" or switchover.committed(interrupted, self._means()):
                await self._recoveries.hand_over(Prepared(interrupted))
        elif (done := interrupted_recovery.concluded(self._gate, self._notices.status)) is not None:
            self._limits.retries.note(done)

    async def _act_on(self, failure: Failure) -> None:
        """Do what is to be done about it now."""
        if failure.switch is not None:
            await self._recoveries.hand_over(failure.switch)
            return
        policy, settings = self._view.policy, self._view.settings
        if failure.planned and policy and settings and not await self._occasions.is_there():
            return
        prepared = self._switching.failed(failure.reason)
        active = self._fleet.find(self._gate.state.active_uid)
        state = self._gate.state
        failed = [PodIdentity(name=state.active, uid=state.active_uid)] if not state.closed else []
        if failure.planned:
            self._levels.handed_over()
            self._notices.event("Normal", "Rescheduling", failure.reason)
        elif failure.follows:
            self._notices.event("Normal", "FollowsDependency", failure.reason)
        else:
            self._notices.add(FailureDetected(time.time() - failure.detected))
        what = "hand-over" if failure.planned else "dependency" if failure.follows else "failure"
        _logger.warning("%s of %s: %s", what, active.name if active else state.active, failure.reason)
        if failure.taken is not None:
            await self._recoveries.carry_out(reflex.begin(failure.taken, failed[0], self._reflexes.deadline))
            return
        if failure.follows and failed:
            if prepared is not None:
                self._leftovers.add(prepared)
            await self._recoveries.carry_out(
                self._dependencies.begin(failure.follows, failed[0], failure.onset, failure.detected)
            )
            return
        progress = Progress.begin(
            failure.reason,
            last_healthy=failure.onset,
            detected=failure.detected,
            failed=[*failed, *self._leftovers.failed()],
            planned=failure.planned,
        )
        progress.target = prepared
        if (first := self._limits.retries.first(failure.reason, failure.onset, state.active_uid)) is None:
            self._postponing.told_to_wait()
            return
        progress.index = first
        await self._hear({one.uid for one in progress.failed})
        await self._recoveries.recover(progress)

    async def _hear(self, failed: Collection[str]) -> None:
        """A new monitor hears of the understudies before it chooses: that a warm one has no connection yet is no reason for a restart."""
        if (left := self._new_until - time.monotonic()) > 0:
            await self._sidecars.settle([i for i in self._fleet.of_workload() if i.uid not in failed], left)

    # -- watching ---------------------------------------------------------------------------------------------------

    async def _watch(self) -> Failure:
        """Look at every deadline until the workload has failed."""
        self.looks.restart()
        while True:
            now = self.looks.begin()
            next_look = now + TICK
            self._limits.pauses.look(now)
            policy = self._view.policy
            if policy is None or self._view.retired:
                self._notices.set(health="Unknown")
                next_look = now + SLOW
            else:
                self._limits.retries.look(self._limits.spending.resumed, now)
                self._sight.follow(policy, self._view.spec)
                self._follow_safety(policy)
                self._dependencies.follow(self._view.settings)
                self._dependencies.look(now)
                self._sight.drain(self._fleet.of_workload(), self._gate.state.active)
                self._keeping.take(policy.state, self._sight.addresses, self._gate.state.active)
                failure, deadline = await self._look(policy, now)
                if failure is not None:
                    return failure
                if deadline is not None:
                    next_look = min(next_look, deadline + WAKE_LATE)
                self._reflexes.guard()
                if (again := self._reflexes.next_look(time.time())) is not None:
                    next_look = min(next_look, again)
            if (clock := time.monotonic()) >= self._next_slow:  # which isn't set, as the other one may be
                self._next_slow = clock + SLOW
                self._housekeeping()
            await self.looks.until(next_look)

    def _follow_safety(self, policy: FailurePolicySpec) -> None:
        if (spec := self._view.spec) is not None:
            self._safety.follow(policy.safety, spec)

    def _waited_since(self) -> float | None:
        """Since when no instance has been verified to be in control; None while one is."""
        progress, held = self._current.progress, self._current.held
        if self._view.retired or (self._limits.pauses.on is not None and (held or progress is None)):
            return None
        return self._unattended.recovering(progress) if progress is not None else self._unattended.since

    async def _look(self, policy: FailurePolicySpec, now: float) -> tuple[Failure | None, float | None]:
        """What is so at this moment: a failure that counts, and else the time to look again at the latest."""
        state = self._gate.state
        if not self._gate.exists:
            self._notices.set(health="Unknown")
            return None, None
        self._enforcement.look(now)
        if state.closed:
            if await self._opening.look(policy, now):
                self._detector.since = time.time()
            return None, None
        active = self._fleet.find(state.active_uid)
        if (taken := self._reflexes.taken_over(now)) is not None:
            if now < self.looks.trusted_from:
                return None, self.looks.trusted_from
            reason = f"{state.active} is silent and {taken.standby.name} has taken over"
            return Failure(reason, taken.last, taken.first, taken), None
        if (loss := self._detector.lost(active, now)) is not None:
            failure, look = loss
            return (self._counted(failure, now) if failure else None), look
        assert active is not None
        verdict = self._detector.verdict(active, now)
        degraded = self._levels.look(policy, verdict, active, now=now, since=self._detector.since)
        self._situations.look(policy, verdict, now=now, since=self._detector.since)
        self._saying.health(verdict, degraded=degraded)
        self._keeping.judge(verdict.state, now)
        if verdict.state != "Starting" and (followed := self._occasions.followed(active, now)) is not None:
            return followed, None
        if verdict.state != "Failed":
            self._detector.well()
            self._dependencies.well(active.name)
            if verdict.state == "Healthy":
                self._unattended.driven()
                self._postponing.healthy()
            if verdict.state == "Healthy" and now - self._detector.since >= seconds(policy.limits.healthy_delay):
                self._limits.retries.healthy()
                if self._notices.status.reason("Recovering") not in ("", "Recovered", "HealthyAgain"):
                    self._notices.condition("Recovering", "False", "HealthyAgain", f"{active.name} is healthy again.")
            if (switch := self._occasions.switchover(verdict, now)) is not None:
                return switch, None
            if verdict.state == "Healthy" and degraded and (due := self._occasions.hand_over(active, now)) is not None:
                return due, None
            return None, self._sight.deadline(now=now, since=self._detector.since)
        detected = time.time()
        if detected < self.looks.trusted_from:
            return None, self.looks.trusted_from
        onset = verdict.onset if verdict.onset is not None else self._detector.onset(active.name, now)
        self._dependencies.notice(onset, detected)
        counts = self._detector.counts_from(detected, policy.monitoring)
        if detected < counts:
            return None, counts
        # What is critical to safety isn't left in control for another's sake: it may do worse than to be silent.
        urgent = policy.priority == "Safety"
        if not urgent and (again := self._dependencies.hold(verdict.reason, onset, now)) is not None:
            return None, again
        return self._counted(Failure(verdict.reason, onset, detected), now), None

    def _counted(self, failure: Failure, now: float) -> Failure | None:
        """The failure, unless the limits say not now."""
        self._keeping.judge("Failed", now)
        self._notices.set(health="Failed", failing_since=failure.onset)
        return self._postponing.admit(failure, now)

    def _housekeeping(self) -> None:
        """What has time: labels on new pods, links to agents, whether the gate is enforced, what would be done now."""
        self._giving_up.look()
        instances = self._fleet.of_workload()
        self._labels.follow(instances)
        self._sidecars.follow(instances)
        policy, settings = self._view.policy, self._view.settings
        if policy is None or settings is None:
            return
        self._saying.housekeeping()
        self._limits.spending.say(time.time())
        paused = self._limits.pauses.on is not None
        instances = [i for i in instances if i.uid != self._switching.preparing]
        self._standbys.housekeeping(instances, policy, settings, paused=paused)
        if not paused:
            self._leftovers.housekeeping(instances, time.monotonic())
        judged = self._enforcement.judge(instances)
        self._reflexes.keep(time.time(), enforced=judged[0] == "True", paused=paused)
        self._enforcement.say(judged)

    # -- recovering -------------------------------------------------------------------------------------------------

    def _means(self) -> Means:
        settings = self._view.settings
        assert settings is not None, "the view waits for the settings"
        return Means(
            gate=self._gate,
            instances=self._fleet,
            agents=self._sidecars,
            outputs=self._sight.outputs(self._fleet, self._gate),
            queue=self._line,
            clock=time.time,
            save=self._save,
            workload_uid=settings.uid,
            kept=self._keeping.select,
            restore_within=seconds(policy.state.within) if (policy := self._view.policy) else 5.0,
            holds=self._repertoire.holds,
        )

    def _save(self, progress: Progress) -> None:
        self._crash_points.step("before save")
        try:
            self._journal.save(progress)
        except OSError as error:
            # A full volume costs what a new monitor would know, and never the robot its recovery. What is beside the gate is newer
            # than what was saved before.
            _logger.error("recovery %s would not outlast a restart: %s", progress.id, error)
            self._forget()

    def _forget(self) -> None:
        """What was saved isn't to be gone on with."""
        with contextlib.suppress(OSError):
            self._journal.clear()

    def _give_up(self, progress: Progress) -> None:
        self._giving_up.note(progress)
        self._forget()

    def _get_ready(self, policy: FailurePolicySpec) -> None:
        """A recovery that an earlier monitor had begun comes before the first look."""
        self._sight.follow(policy, self._view.spec)
        self._follow_safety(policy)
        self._keeping.follow(policy.state)
        self._sidecars.follow(self._fleet.of_workload())

    def _meanwhile(self) -> None:
        """What goes on while a recovery is held."""
        if (policy := self._view.policy) is not None:
            self._follow_safety(policy)
        self._sight.drain(self._fleet.of_workload(), "")
        self._housekeeping()
