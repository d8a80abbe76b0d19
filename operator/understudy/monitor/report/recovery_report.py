"""Reports the result of a recovery or a planned switchover: conditions, Events and the log."""

from __future__ import annotations

import logging
import time

from understudy.api.kinds.robot_workload import GateStatus, Recovery
from understudy.failover.interfaces import Gate
from understudy.monitor.act.recovery.recovery_messages import describe, describe_switchover, unverified
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.notices import FailureDetected, Notices
from understudy.monitor.outcome import Outcome

_logger = logging.getLogger(__name__)


class RecoveryReport:
    """Reports the recoveries of one workload."""

    def __init__(self, gate: Gate, notices: Notices) -> None:
        self._gate, self._notices = gate, notices

    def begins(self, failure: Failure) -> None:
        """Report what is about to be recovered or handed over."""
        if failure.planned:
            what = "planned switchover"
            self._notices.event("Normal", "Rescheduling", failure.reason)
        elif failure.follows:
            what = "dependency"
            self._notices.event("Normal", "FollowsDependency", failure.reason)
        else:
            what = "failure"
            self._notices.add(FailureDetected(time.time() - failure.detected))
        _logger.warning("%s of %s: %s", what, self._gate.state.active, failure.reason)

    def abandoned(self, outcome: Outcome) -> None:
        """Report that a recovery was superseded, stopped or not needed."""
        progress, error, superseded = outcome.progress, outcome.error, outcome.kind == "Superseded"
        if outcome.kind == "NoLongerNeeded":
            words = f"nothing was changed, because {error} ({progress.reason})"
            _logger.warning("recovery %s ended: %s", progress.id, words)
            self._notices.condition("Recovering", "False", "HealthyAgain", f"{words[0].upper()}{words[1:]}.")
            self._notices.event("Normal", "RecoveryNotNeeded", words)
            return
        if superseded:
            _logger.warning("recovery %s given up: %s", progress.id, error)
        else:
            _logger.error("recovery %s stopped", progress.id, exc_info=error)
        event = "RecoverySuperseded" if superseded else "RecoveryError"
        words = str(error) if superseded else f"{progress.reason}: {error}"
        self._notices.condition("Recovering", "False", "Superseded" if superseded else "Error", words)
        self._notices.event("Warning", event, f"{progress.reason}: {error}")

    def concluded(self, outcome: Outcome, recovery: Recovery) -> str:
        """Report a recorded recovery. Returns its description."""
        state = self._gate.state
        self._notices.set(active=state.active, gate=GateStatus(epoch=state.epoch, active=state.active))
        if outcome.kind in ("SwitchedOver", "NotSwitchedOver"):
            return self._switched(outcome, recovery)
        text = describe(recovery)
        _logger.warning("recovery %d: %s", recovery.number, text)
        if outcome.kind == "Recovered":
            self._notices.condition("Recovering", "False", "Recovered", text)
            self._notices.event("Normal", "Recovered", text)
            for words in unverified(recovery):
                self._notices.event("Warning", "StrategyNotVerified", f"{words}. The next strategy took over.")
            self._notices.set(health="Healthy")
        else:
            self._notices.set(health="Failed")
            self._notices.condition("Recovering", "False", "NothingVerified", text)
            self._notices.event("Warning", "RecoveryFailed", text)
        return text

    def _switched(self, outcome: Outcome, recovery: Recovery) -> str:
        text, done = describe_switchover(recovery), outcome.kind == "SwitchedOver"
        _logger.warning("switchover %d: %s", recovery.number, text)
        self._notices.event("Normal" if done else "Warning", "SwitchedOver" if done else "SwitchoverNotDone", text)
        return text
