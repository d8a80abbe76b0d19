"""The judge stage of one workload: judges the active instance by the observations of one instant."""

from __future__ import annotations

import time
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.decide import Trigger
from understudy.failover.interfaces import Gate, Instance, Instances
from understudy.monitor.judge.degradation_level import DegradationLevel
from understudy.monitor.judge.failure_detection import Failure, FailureDetector
from understudy.monitor.judge.gate_enforcement import GateEnforcement
from understudy.monitor.judge.reassessment import Reassessment
from understudy.monitor.judge.reflex_takeover import ReflexTakeover
from understudy.monitor.judge.situation_tracking import SituationTracking
from understudy.monitor.judge.sole_driver import SoleDriver
from understudy.monitor.judge.unseen_restart import UnseenRestart
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.pod_interfaces import PodInterfaces
from understudy.monitor.observe.senses import Senses
from understudy.state.state_store import StateSource
from understudy.trees.core.health_tree import Verdict


@dataclass(frozen=True)
class Judgement:
    """The state of the active instance at one instant. Times are Unix seconds."""

    now: float
    trusted_from: float = 0.0
    """Silence counts from this time on. It is later than ``now`` if the process was stalled and has not caught up."""
    active: Instance | None = None
    """The active instance; None if the gate is closed, or if the pod is gone."""
    verdict: Verdict | None = None
    """The verdict of the health tree; None if the tree does not matter: the pod is lost, or the robot follows a standby."""
    degraded: bool = False
    last_well: float = 0.0
    """When the active instance was last seen to be healthy; ``now`` if it never was."""
    settled: bool = False
    """Whether the instance has been healthy for ``limits.healthyDelay``, so that its next failure is a new one."""
    failure: Failure | None = None
    counts_from: float = 0.0
    """When the failure of a health tree counts: the end of ``monitoring.debounce``."""
    deadline: float | None = None
    """When to judge again at the latest; None if the next tick is early enough."""

    @property
    def healthy(self) -> bool:
        """Whether the health tree succeeds."""
        return self.verdict is not None and self.verdict.state == "Healthy"


class JudgeStage:
    """Judges the active instance and the gate."""

    def __init__(
        self,
        view: ClusterView,
        pods: Instances,
        gate: Gate,
        senses: Senses,
        kept_from: StateSource | None,
        notices: Notices,
    ) -> None:
        """``kept_from`` is the instance from which an earlier monitor kept state."""
        self._pods, self._gate, self._observer = pods, gate, senses.observer
        self.detector = FailureDetector(pods, gate, senses.agents, senses.observer, notices.status.driven_epoch)
        self.takeover = ReflexTakeover(view, pods, gate, senses.observer, senses.probes)
        self.levels = DegradationLevel(senses.observer, notices)
        self.situations = SituationTracking(senses.observer, notices)
        self.unseen_restart = UnseenRestart(senses.observer, kept_from)
        self.reassessment = Reassessment(pods, senses.observer, self.unseen_restart, senses.probes)
        interfaces = PodInterfaces(view, pods, senses.agents)
        self.enforcement = GateEnforcement(gate, senses.probes, notices, senses.readership, interfaces)
        self.sole_driver = SoleDriver(gate, senses.probes, senses.observer, notices)

    def judge(self, policy: FailurePolicySpec, now: float, trusted_from: float) -> Judgement:
        """Return the judgement: a takeover by the reflex comes first, then a lost pod, then the health tree."""
        self.enforcement.update(now)
        self.sole_driver.update(self._pods.of_workload(), now)
        state = self._gate.state
        if state.closed:
            self.unseen_restart.rest()
            return Judgement(now, trusted_from)
        active = self._pods.find(state.active_uid)
        if (taken := self.takeover.detect(now)) is not None:
            reason = f"{state.active} is silent and {taken.standby.name} has taken over"
            failure = Failure(reason, taken.last, taken.first, Trigger.REFLEX_TAKEOVER, taken)
            return Judgement(now, trusted_from, active, failure=failure)
        if (loss := self.detector.lost(active, now)) is not None:
            lost, again = loss
            return Judgement(now, trusted_from, active, failure=lost, deadline=again)
        assert active is not None
        keeps_state = bool(policy.state.keep or policy.state.parameters or policy.state.lifecycle)
        if (onset := self.unseen_restart.onset(active, now, keeps_state=keeps_state)) is not None:
            reason = f"a container of {active.name} restarted while no monitor watched, so its state is lost"
            failure = Failure(reason, onset, time.time(), Trigger.POD_LOST)
            return Judgement(now, trusted_from, active, failure=failure)
        return self._by_health(policy, active, now, trusted_from)

    def _by_health(self, policy: FailurePolicySpec, active: Instance, now: float, trusted_from: float) -> Judgement:
        verdict = self.detector.verdict(active, now)
        since = self.detector.since
        degraded = self.levels.evaluate(policy, verdict, active, now=now, since=since)
        self.situations.update(policy, verdict, now=now, since=since)
        last_well = self.detector.onset(active.name, now)
        if verdict.state != "Failed":
            self.detector.well()
            settled = verdict.state == "Healthy" and now - since >= seconds(policy.limits.healthy_delay)
            deadline = self._observer.deadline(now=now, since=since)
            return Judgement(now, trusted_from, active, verdict, degraded, last_well, settled, deadline=deadline)
        detected = time.time()
        onset = verdict.onset if verdict.onset is not None else last_well
        counts = self.detector.counts_from(detected, policy.monitoring) if detected >= trusted_from else detected
        failure = Failure(verdict.reason, onset, detected)
        return Judgement(
            detected, trusted_from, active, verdict, degraded, last_well, failure=failure, counts_from=counts
        )
