"""Determines from past recoveries when the next recovery may begin, and with which strategy."""

from __future__ import annotations

import logging
import time

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.clock import CLOCK
from understudy.failover.limits import cooldown
from understudy.failover.limits.backoff import FIRST, Backoff
from understudy.failover.limits.escalation import Takeover, first_strategy
from understudy.failover.limits.state import ActiveLimit
from understudy.failover.progress import Progress
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView

_logger = logging.getLogger(__name__)


class RetryBackoff:
    """The wait between the recoveries of one workload. Times are Unix seconds."""

    def __init__(self, view: ClusterView, notices: Notices) -> None:
        self._view, self._notices = view, notices
        self._backoff = Backoff()
        self._latest: Takeover | None = None
        self._inputs: tuple[object, ...] = ()
        """The policy, spec and settings of the last update."""
        self._resumed: float | None = None

    @property
    def not_before(self) -> float:
        """When the next recovery may begin."""
        return self._backoff.not_before

    @property
    def retry_after(self) -> float:
        """Seconds of the backoff after the next recovery without success."""
        return self._backoff.step

    def in_force(self, now: float) -> ActiveLimit | None:
        """Return the wait after the last recovery, if it has not ended."""
        return self._backoff.in_force(now)

    def update(self, resumed: float | None, now: float) -> None:
        """End the wait early if a user asked to resume (at ``resumed``) or changed the configuration."""
        self._backoff = self._backoff.at(now)
        if self._corrected() or resumed != self._resumed:
            self._backoff = self._backoff.cleared(now)
        self._resumed = resumed

    def _corrected(self) -> bool:
        """Return whether the policy, spec or settings changed since no strategy was verified. The change may be a correction."""
        inputs = (self._view.policy, self._view.spec, self._view.settings)
        if len(inputs) == len(self._inputs) and all(a is b for a, b in zip(inputs, self._inputs, strict=True)):
            return False
        before, self._inputs = self._inputs, inputs
        return self._backoff.step > FIRST and before != inputs

    def healthy(self) -> None:
        """Note that the active instance has been healthy for long enough: the next failure is a new one."""
        self._backoff = self._backoff.healthy()

    def note(self, done: Progress) -> None:
        """Note a finished recovery, which may be one of an earlier monitor."""
        self._latest = Takeover.of(done)

    def after_recovery(self, policy: FailurePolicySpec) -> None:
        """Wait for the policy's cooldown."""
        self.after(cooldown.length(policy))

    def after_error(self) -> None:
        """Wait for the shortest backoff: the API server refused something."""
        self.after(FIRST)

    def after(self, wait: float) -> None:
        """Allow the next recovery only after ``wait`` seconds."""
        self._backoff = self._backoff.after(wait, time.time())

    def after_nothing_verified(self, policy: FailurePolicySpec) -> None:
        """Wait for a backoff, which grows each time unless the policy has priority Safety."""
        self._backoff = self._backoff.failed(time.time(), policy)

    def first(self, onset: float, failed_uid: str) -> int | None:
        """Return the index of the strategy to start with after a failure that began at ``onset``.

        None if the instance of every strategy failed as soon as it was active.
        """
        if (policy := self._view.policy) is None or self._view.settings is None:
            return 0
        delay = seconds(policy.limits.healthy_delay)
        return first_strategy(
            self._latest, failed_uid, CLOCK.of_system(onset), len(policy.strategies), healthy_delay=delay
        )

    def begin(self, failure: Failure, failed_uid: str) -> None:
        """Note that a recovery begins. Report it if the active instance failed soon after it took over."""
        latest, self._latest = self._latest, None
        onset = CLOCK.of_system(failure.onset)
        policy = self._view.policy
        if policy is None or latest is None or (lived := latest.lived(failed_uid, onset)) is None:
            return
        delay = policy.limits.healthy_delay
        if first_strategy(latest, failed_uid, onset, len(policy.strategies), healthy_delay=seconds(delay)):
            text = (
                f"{failure.reason}, {max(0.0, lived):.1f} s after it took over (limits.healthyDelay is {delay}); the next "
                "strategy is tried"
            )
            _logger.warning("%s", text)
            self._notices.event("Warning", "Relapsed", text)

    def crash_looping(self, reason: str) -> None:
        """Report that the instance of every strategy failed as soon as it was active, and wait for a backoff."""
        self._latest = None
        if (policy := self._view.policy) is None:
            return
        text = (
            f"{reason}, as soon as it was active (limits.healthyDelay is {policy.limits.healthy_delay}). Every strategy was tried; the "
            f"first one is tried again in {self.retry_after:g} s"
        )
        _logger.warning("%s", text)
        self._notices.condition("Recovering", "False", "CrashLooping", f"{text}.")
        self._notices.event("Warning", "CrashLooping", text)
        self.after_nothing_verified(policy)
