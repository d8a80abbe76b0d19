"""Applies the limits to a failure: it is recovered now, or it is deferred and reported once."""

from __future__ import annotations

from dataclasses import replace

from understudy.failover.decide import Defer, Facts, Occurrence, Trigger, decide
from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.notices import Notices, RecoveryDeferred


class Postponing:
    """The deferred failures of one workload. Times are unix seconds."""

    def __init__(self, notices: Notices, limits: Limits, repertoire: Repertoire) -> None:
        self._notices, self._limits, self._repertoire = notices, limits, repertoire
        self._reported = ""
        """The reason that was reported for deferring the present failure."""

    def conclude(self) -> None:
        """Note that the next failure is a new one."""
        self._reported = ""

    def healthy(self) -> None:
        """Note that the active instance is healthy: a failure later in the same pause is reported again."""
        self._reported = "" if self._reported == "Paused" else self._reported

    def told_to_wait(self) -> None:
        """Note that the wait of the present failure was reported already."""
        self._reported = "Waiting"

    def admit(self, failure: Failure, now: float) -> Failure | None:
        """Return the failure if it is to be recovered now; None if a limit defers it."""
        limits = self._limits.in_force(now)
        ready = limits.storm is not None and self._repertoire.stands_by()
        decision = decide(Facts(now, (Occurrence(Trigger.HEALTH_FAILED, failure.reason),), limits, standby_ready=ready))
        if isinstance(decision, Defer):
            self._defer(decision, failure)
            return None
        self._reported = ""
        # Outputs that were missing during a pause are not a failure.
        return replace(failure, onset=max(failure.onset, min(self._limits.pauses.ended, failure.detected)))

    def _defer(self, decision: Defer, failure: Failure) -> None:
        """Report why the failure is deferred, once."""
        if self._reported != decision.reason:
            self._reported = decision.reason
            text = f"{failure.reason}; {decision.message}"
            self._notices.add(RecoveryDeferred(decision.reason))
            # If the pod is gone, the health tree does not report the failure.
            self._notices.condition("Healthy", "False", "Failed", failure.reason)
            self._notices.condition("Recovering", "False", decision.reason, f"{text.rstrip('.')}.")
            self._notices.event("Warning", "RecoveryPostponed", text)
