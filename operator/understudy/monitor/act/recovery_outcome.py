"""What follows from a recovery or a switchover that is over: it is recorded, counted and told, and watching begins anew."""

from __future__ import annotations

import logging
import time

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import GateStatus, Recovery
from understudy.failover.interfaces import Gate, Superseded
from understudy.failover.progress import Progress
from understudy.monitor.act.garbage_collection import Leftovers
from understudy.monitor.act.planned_switchover import Switching
from understudy.monitor.act.recovery_messages import describe, describe_switchover, unverified
from understudy.monitor.act.safe_commands import Unattended
from understudy.monitor.act.state_keeping import StateKeeping
from understudy.monitor.decide.deferred_failures import Postponing
from understudy.monitor.decide.limits import Limits
from understudy.monitor.judge.failure_detection import Detector
from understudy.monitor.notices import Notices
from understudy.monitor.observe.dependencies import Dependencies

_logger = logging.getLogger(__name__)


class Aftermath:
    """Of the recoveries of one workload."""

    def __init__(
        self,
        gate: Gate,
        notices: Notices,
        keeping: StateKeeping,
        detector: Detector,
        limits: Limits,
        postponing: Postponing,
        unattended: Unattended,
        dependencies: Dependencies,
        leftovers: Leftovers,
        switching: Switching,
    ) -> None:
        self._gate, self._notices, self._keeping = gate, notices, keeping
        self._detector, self._limits, self._postponing = detector, limits, postponing
        self._unattended, self._dependencies = unattended, dependencies
        self._leftovers, self._switching = leftovers, switching

    def superseded(self, progress: Progress, reason: Superseded) -> None:
        """Somebody else acts at a newer epoch: watch again."""
        _logger.warning("recovery %s given up: %s", progress.id, reason)
        self._notices.condition("Recovering", "False", "Superseded", str(reason))
        self._notices.event("Warning", "RecoverySuperseded", f"{progress.reason}: {reason}")
        self._unattended.driven()
        self._begin_anew()
        self._limits.retries.after(0.0)

    def stopped(self, progress: Progress, error: Exception) -> None:
        """The API server refused something: all is tried again in a moment."""
        _logger.error("recovery %s stopped", progress.id, exc_info=error)
        self._notices.condition("Recovering", "False", "Error", f"{progress.reason}: {error}")
        self._notices.event("Warning", "RecoveryError", f"{progress.reason}: {error}")
        self._begin_anew()
        self._limits.retries.after_error()

    def recovered(self, done: Progress, policy: FailurePolicySpec) -> None:
        """A recovery is over, whether or not a strategy was verified."""
        self._limits.retries.note(done)
        recovery = self._notices.record(done)
        self._limits.spending.count(done, time.time())
        self._dependencies.note(done.follows)
        self._tell(recovery)
        text = describe(recovery)
        _logger.warning("recovery %d: %s", recovery.number, text)
        if done.result == "Recovered":
            self._leftovers.remember()
            self._unattended.driven()
            self._notices.condition("Recovering", "False", "Recovered", text)
            self._notices.event("Normal", "Recovered", text)
            for words in unverified(recovery):
                self._notices.event("Warning", "StrategyNotVerified", f"{words}. The next strategy took over.")
            self._notices.set(health="Healthy")
            self._begin_anew(done)
            self._limits.retries.after_recovery(policy)
        else:
            self._unattended.nothing_verified(time.time())
            self._notices.set(health="Failed")
            self._notices.condition("Recovering", "False", "NothingVerified", text)
            self._notices.event("Warning", "RecoveryFailed", text)
            self._begin_anew()
            self._limits.retries.after_nothing_verified(policy)

    def switched(self, progress: Progress) -> None:
        """The gate was switched as planned, and it was seen what came of it. What was put off before stays so."""
        recovery = self._notices.record(progress)
        text, done = describe_switchover(recovery), progress.result == "Recovered"
        _logger.warning("switchover %d: %s", recovery.number, text)
        self._leftovers.remember()
        self._unattended.driven()
        self._tell(recovery)
        self._notices.event("Normal" if done else "Warning", "SwitchedOver" if done else "SwitchoverNotDone", text)
        self._switching.done(progress, f"{text}.")
        self._begin_anew(progress if done else None)

    def _tell(self, recovery: Recovery) -> None:
        state = self._gate.state
        self._notices.set(active=state.active, gate=GateStatus(epoch=state.epoch, active=state.active))
        self._keeping.tell(recovery)

    def _begin_anew(self, done: Progress | None = None) -> None:
        self._detector.restart()
        self._postponing.begin_anew()
        if done is not None:
            # Its samples count from the commit, so that an understudy that fails at once is noticed in the usual time.
            self._detector.since = done.moments.get("committing", self._detector.since)
