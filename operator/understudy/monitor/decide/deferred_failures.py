"""What has failed and isn't acted on yet: in a pause, in a storm, and for a while after the last recovery. It is told, once."""

from __future__ import annotations

from dataclasses import replace

from understudy.monitor.decide.limits import Limits
from understudy.monitor.decide.strategy_options import Repertoire
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.report import monitor_metrics
from understudy.monitor.report.reporter import Reporter


class Postponing:
    """Puts off the failures of one workload. Times are unix seconds."""

    def __init__(self, reporter: Reporter, limits: Limits, repertoire: Repertoire) -> None:
        self._reporter, self._limits, self._repertoire = reporter, limits, repertoire
        self._told = ""
        """What puts off the present failure, once that was told."""

    def begin_anew(self) -> None:
        """What fails from now on is another failure."""
        self._told = ""

    def healthy(self) -> None:
        """The instance in control is healthy: one that fails in the same pause is told of again."""
        self._told = "" if self._told == "Paused" else self._told

    def told_to_wait(self) -> None:
        """That the present failure waits was told already."""
        self._told = "Waiting"

    def admit(self, failure: Failure, now: float) -> Failure | None:
        """The failure, unless the limits say not now."""
        if (pause := self._limits.pauses.on) is not None:
            self._postpone("Paused", failure, f"nothing is done about it: it is {pause.words}")
            return None
        if now < self._limits.retries.not_before:
            self._postpone("Waiting", failure, f"tried again in {self._limits.retries.not_before - now:.0f} s")
            return None
        if (storm := self._limits.storms.on(now)) is not None and not self._repertoire.stands_by():
            self._postpone("Storm", failure, f"it waits, since others fail too: {storm}")
            return None
        self._told = ""
        # What it went without in the pause was nobody's failure.
        return replace(failure, onset=max(failure.onset, min(self._limits.pauses.ended, failure.detected)))

    def _postpone(self, why: str, failure: Failure, then: str) -> None:
        """Say why nothing is done yet, once."""
        if self._told != why:
            self._told = why
            text = f"{failure.reason}; {then}"
            monitor_metrics.held(why)
            # Of a pod that is gone no tree says so.
            self._reporter.condition("Healthy", "False", "Failed", failure.reason)
            self._reporter.condition("Recovering", "False", why, f"{text.rstrip('.')}.")
            self._reporter.event("Warning", "RecoveryPostponed", text)
