"""The act stage of one workload, assembled from its parts."""

from __future__ import annotations

import asyncio
import time

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.progress import Progress
from understudy.monitor.act.gate.gate_opening import GateOpening
from understudy.monitor.act.gate.leak_response import LeakResponse
from understudy.monitor.act.gate.reflex_guard import ReflexGuard
from understudy.monitor.act.instances.garbage_collection import GarbageCollection
from understudy.monitor.act.instances.pod_labels import PodLabels
from understudy.monitor.act.instances.standby_supervision import StandbySupervision
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.instances.stray_pods import StrayPods
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.recovery.abandonment import Abandonment
from understudy.monitor.act.recovery.deferred_recovery import DeferredRecovery
from understudy.monitor.act.recovery.planned_switchover import PlannedSwitchovers
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner, RecoveryStart
from understudy.monitor.act.safe_commands import SafeCommands, Unattended
from understudy.monitor.decide.stage import DecideStage
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.notices import Notices
from understudy.monitor.observe.senses import Senses
from understudy.monitor.outcome import Outcome


class ActStage:
    """Changes the cluster, commands agents, and sends safe commands to the robot."""

    def __init__(
        self,
        cluster: Cluster,
        senses: Senses,
        state_manager: StateManager,
        journal: RecoveryJournal,
        decide: DecideStage,
        notices: Notices,
    ) -> None:
        self._cluster, self._senses, takeover = cluster, senses, decide.takeover
        options, limits, current = decide.options, decide.limits, senses.current
        self.state_manager = state_manager
        self.unattended = Unattended(cluster.view, limits.pauses, current)
        self.safety = SafeCommands(
            senses.observer.graph, self.unattended, senses.observer.outputs(cluster.pods, cluster.gate)
        )
        self.garbage = GarbageCollection(cluster.pods, cluster.gate, notices)
        self.abandonment = Abandonment(cluster.gate, journal, notices)
        self.switchovers = PlannedSwitchovers(cluster, options, state_manager, current, self.garbage, notices)
        self.reflexes = ReflexGuard(cluster, senses, takeover, notices)
        self.start = RecoveryStart(cluster, self.switchovers, self.garbage, limits.retries, takeover)
        self.opening = GateOpening(cluster.pods, cluster.gate, options, state_manager, notices)
        self.strays = StrayPods(cluster.view)
        self.leaks = LeakResponse(cluster.pods, self.strays, cluster.gate, decide.sole_driver, notices)
        self.deferral = DeferredRecovery(cluster, limits, current, journal, notices)
        self.recoveries = RecoveryRunner(cluster.view, options, state_manager, current, self.abandonment, notices)
        self.labels = PodLabels(cluster)
        self._raising: asyncio.Task[None] | None = None
        self._standbys = StandbySupervision(cluster, senses, state_manager, decide.unseen_restart, notices)

    def judged(self, judgement: Judgement) -> None:
        """Note the judgement: state is kept and no safe command is sent while the active instance is healthy."""
        if judgement.verdict is not None:
            self.state_manager.judge(judgement.verdict.state, judgement.now)
        elif judgement.failure is not None and judgement.failure.taken is None:
            self.state_manager.judge("Failed", judgement.now)
        if judgement.healthy:
            self.unattended.driven()

    def follow_safety(self, policy: FailurePolicySpec) -> None:
        """Prepare to send the policy's safe commands."""
        if (spec := self._cluster.view.spec) is not None:
            self.safety.follow(policy.safety, spec)

    def get_ready(self, policy: FailurePolicySpec) -> None:
        """Prepare every part for a recovery by this policy. Needed for a recovery that an earlier monitor began, which
        is continued before the first evaluation."""
        self._senses.observer.follow(policy, self._cluster.view.spec)
        self.follow_safety(policy)
        self.state_manager.follow(policy.state)
        self._senses.agents.follow(self._cluster.pods.of_workload())

    def keep_connected(self) -> None:
        """Keep connections to agents, and mark abandoned recoveries at the gate. Returns at once."""
        self.abandonment.update()
        self._senses.agents.follow(self._cluster.pods.of_workload())

    async def restore_routing(self) -> None:
        """Undo what somebody else changed in whom the gate lets through."""
        await self._cluster.gate.restore_routing()

    def raise_epoch(self) -> None:
        """Have what the gate says carried out at the robot and by the agents again, if it is not. Returns at once."""
        known = self._senses.agents.newest_epoch
        if self._cluster.gate.epoch_problem(known) and (self._raising is None or self._raising.done()):
            self._raising = asyncio.create_task(self._cluster.gate.raise_epoch(known))

    async def restore_record(self, progress: Progress) -> None:
        """Name a recovery under way beside the gate again, if somebody deleted the gate."""
        await self._cluster.gate.restore_record(progress)

    def supervise_standbys(self, policy: FailurePolicySpec, *, paused: bool) -> None:
        """Bring instances up, give them state, and delete what recoveries left behind. Returns at once."""
        view = self._cluster.view
        if (settings := view.settings) is None:
            return
        instances = [i for i in self._cluster.pods.of_workload() if i.uid != self.switchovers.preparing]
        self._standbys.housekeeping(instances, policy, settings, paused=paused)
        if paused:
            self.garbage.remember()
        else:
            self.garbage.housekeeping(instances, time.monotonic())

    def conclude(self, outcome: Outcome) -> None:
        """Remember the outcome of a recovery or a switchover."""
        self.unattended.conclude(outcome)
        if outcome.kind == "NoLongerNeeded":
            self.opening.drop(outcome.progress)
        for pod in outcome.left:
            self.garbage.add(pod)
