"""When something may be begun again after a recovery, and with which strategy: what came to nothing is put off, longer each time, but
not once what was wrong may have been corrected.
"""

from __future__ import annotations

import logging
import time

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.limits.escalation import Escalation
from understudy.failover.progress import Progress
from understudy.monitor.observe.cluster_view import View
from understudy.monitor.report.reporter import Reporter

_logger = logging.getLogger(__name__)

BACKOFF_FIRST, BACKOFF_MOST = 2.0, 60.0
"""Seconds before everything is tried again after no strategy verified."""


class Retries:
    """What of one workload may be begun again. Times are unix seconds."""

    def __init__(self, view: View, reporter: Reporter) -> None:
        self._view, self._reporter = view, reporter
        self._escalation = Escalation()
        self._backoff = BACKOFF_FIRST
        self._given: tuple[object, ...] = ()
        self._resumed: float | None = None
        self.not_before = 0.0
        """When something may be begun."""
        self._wait = 0.0
        """Seconds that this was put off by."""

    def look(self, resumed: float | None, now: float) -> None:
        """Look whether it need be put off no longer. ``resumed`` is when somebody last said to go on."""
        self.not_before = min(self.not_before, now + self._wait)  # it is later where the clock was set back since
        self._notice_correction(now)
        # Somebody has looked at it and says to go on: that isn't put off either.
        if resumed != self._resumed:
            self._resumed = resumed
            self._backoff, self.not_before = BACKOFF_FIRST, now

    def _notice_correction(self, now: float) -> None:
        """Where no strategy verified, what was changed since may be the correction: trying it isn't put off."""
        given = (self._view.policy, self._view.spec, self._view.settings)
        if len(given) == len(self._given) and all(a is b for a, b in zip(given, self._given, strict=True)):
            return
        before, self._given = self._given, given
        if self._backoff > BACKOFF_FIRST and before != given:
            self._backoff, self.not_before = BACKOFF_FIRST, now

    def healthy(self) -> None:
        """The instance in control has been healthy for long enough: what comes next is another failure."""
        self._backoff = BACKOFF_FIRST

    def note(self, done: Progress) -> None:
        """A recovery is over, or was by an earlier monitor."""
        self._escalation.note(done)

    def after(self, wait: float) -> None:
        """Begin nothing for so many seconds."""
        self.not_before, self._wait = time.time() + wait, wait

    def after_nothing_verified(self, policy: FailurePolicySpec) -> None:
        """Begin nothing for a while, and for longer the next time, unless it is critical to safety."""
        self.after(self._backoff)
        self._backoff = BACKOFF_FIRST if policy.priority == "Safety" else min(2 * self._backoff, BACKOFF_MOST)

    def first(self, reason: str, onset: float, failed_uid: str) -> int | None:
        """The strategy to begin with. None where every one's instance failed at once: they are tried again after a pause."""
        policy, settings = self._view.policy, self._view.settings
        if policy is None or settings is None:
            return 0
        lived, delay = self._escalation.lived(failed_uid, onset), policy.limits.healthy_delay
        first = self._escalation.first(failed_uid, onset, len(policy.strategies), healthy_delay=seconds(delay))
        if first and lived is not None:
            text = (
                f"{reason}, {max(0.0, lived):.1f} s after it took over (limits.healthyDelay is {delay}): the next "
                "strategy has its turn"
            )
            _logger.warning("%s", text)
            self._reporter.event("Warning", "Relapsed", text)
        if first is None:
            text = (
                f"{reason}, as soon as it was in control (limits.healthyDelay is {delay}). Every strategy was tried; the "
                f"first one is tried again in {self._backoff:g} s"
            )
            _logger.warning("%s", text)
            self._reporter.condition("Recovering", "False", "EndsAgainAndAgain", f"{text}.")
            self._reporter.event("Warning", "EndsAgainAndAgain", text)
            self.after_nothing_verified(policy)
        return first
