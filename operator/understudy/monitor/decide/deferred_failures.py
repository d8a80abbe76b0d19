"""Reports once why a failure is deferred."""

from __future__ import annotations

from understudy.failover.decide import Defer
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.notices import Notices, RecoveryDeferred


class DeferredFailures:
    """Remembers what was reported about the present failure of one workload."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._reported = ""
        """The reason that was reported for deferring the present failure."""

    def conclude(self) -> None:
        """Note that the next failure is a new one."""
        self._reported = ""

    def healthy(self) -> None:
        """Note that the active instance is healthy: a failure later in the same pause is reported again."""
        self._reported = "" if self._reported == "Paused" else self._reported

    def reported_wait(self) -> None:
        """Note that the wait for the present failure was reported elsewhere."""
        self._reported = "Waiting"

    def report(self, decision: Defer, failure: Failure) -> None:
        """Report why the failure is deferred, once for each reason."""
        if self._reported != decision.reason:
            self._reported = decision.reason
            text = f"{failure.reason}; {decision.message}"
            self._notices.add(RecoveryDeferred(decision.reason))
            # If the pod is gone, the health tree does not report the failure.
            self._notices.condition("Healthy", "False", "Failed", failure.reason)
            self._notices.condition("Recovering", "False", decision.reason, f"{text.rstrip('.')}.")
            self._notices.event("Warning", "RecoveryPostponed", text)
