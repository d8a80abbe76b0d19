"""The act stage of one workload: its parts, put together."""

from __future__ import annotations

import time

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.monitor.act.abandonment import Abandonment
from understudy.monitor.act.cluster import Cluster
from understudy.monitor.act.deferred_recovery import Deferral
from understudy.monitor.act.garbage_collection import Leftovers
from understudy.monitor.act.gate_opening import GateOpening
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.act.pod_labels import Labels
from understudy.monitor.act.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery_runner import Recoveries, RecoveryStart
from understudy.monitor.act.reflex_guard import Reflexes
from understudy.monitor.act.safe_commands import SafeCommands, Unattended
from understudy.monitor.act.standby_supervision import Standbys
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.decide.stage import DecideStage
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.notices import Notices
from understudy.monitor.observe.senses import Senses
from understudy.monitor.outcome import Outcome


class ActStage:
    """What changes the cluster, commands agents and sends to the robot."""

    def __init__(
        self,
        cluster: Cluster,
        senses: Senses,
        keeping: StateKeeping,
        journal: RecoveryJournal,
        decide: DecideStage,
        notices: Notices,
    ) -> None:
        self._cluster, self._senses, takeover = cluster, senses, decide.takeover
        repertoire, limits, current = decide.repertoire, decide.limits, senses.current
        self.keeping = keeping
        self.unattended = Unattended(cluster.view, limits.pauses, current)
        self.safety = SafeCommands(senses.sight.graph, self.unattended)
        self.leftovers = Leftovers(cluster.pods, cluster.gate, notices)
        self.abandonment = Abandonment(cluster.gate, journal, notices)
        self.switchovers = Switching(cluster, repertoire, keeping, current, self.leftovers, notices)
        self.reflexes = Reflexes(cluster, senses, takeover, notices)
        self.start = RecoveryStart(cluster, self.switchovers, self.leftovers, limits.retries, takeover)
        self.opening = GateOpening(cluster.pods, cluster.gate, notices)
        self.deferral = Deferral(cluster, limits, current, journal, notices)
        self.recoveries = Recoveries(cluster.view, repertoire, keeping, current, self.abandonment, notices)
        self._labels = Labels(cluster.pods)
        self._standbys = Standbys(cluster, senses.sidecars, senses.roles, current, keeping, notices)

    def judged(self, judgement: Judgement) -> None:
        """Remember how the active instance is: its state is kept while it is healthy, and then nothing is unattended."""
        if judgement.verdict is not None:
            self.keeping.judge(judgement.verdict.state, judgement.now)
        elif judgement.failure is not None and judgement.failure.taken is None:
            self.keeping.judge("Failed", judgement.now)
        if judgement.healthy:
            self.unattended.driven()

    def follow_safety(self, policy: FailurePolicySpec) -> None:
        """Be ready to send the policy's safe commands."""
        if (spec := self._cluster.view.spec) is not None:
            self.safety.follow(policy.safety, spec)

    def get_ready(self, policy: FailurePolicySpec) -> None:
        """Prepare for a recovery by this policy: one that an earlier monitor began comes before the first look."""
        self._senses.sight.follow(policy, self._cluster.view.spec)
        self.follow_safety(policy)
        self.keeping.follow(policy.state)
        self._senses.sidecars.follow(self._cluster.pods.of_workload())

    def keep_connected(self) -> None:
        """Label new pods, keep connections to agents, and mark abandoned recoveries at the gate. Returns at once."""
        self.abandonment.look()
        instances = self._cluster.pods.of_workload()
        self._labels.follow(instances)
        self._senses.sidecars.follow(instances)

    def care_for_standbys(self, policy: FailurePolicySpec, *, paused: bool) -> None:
        """Bring instances up, give them state, and delete what recoveries left behind. Returns at once."""
        view = self._cluster.view
        if (settings := view.settings) is None:
            return
        instances = [i for i in self._cluster.pods.of_workload() if i.uid != self.switchovers.preparing]
        self._standbys.housekeeping(instances, policy, settings, paused=paused)
        if not paused:
            self.leftovers.housekeeping(instances, time.monotonic())

    def conclude(self, outcome: Outcome) -> None:
        """Remember the outcome of a recovery or a switchover."""
        self.unattended.conclude(outcome)
        if outcome.concluded and outcome.kind != "NothingVerified":
            self.leftovers.remember()
