"""The wait after a recovery: the policy's cooldown, or a growing backoff after attempts without success; pure.

Times are unix seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.limits.state import ActiveLimit

FIRST, MOST = 2.0, 60.0
"""Seconds until all strategies are tried again after none of them verified: at first, and at most."""


@dataclass(frozen=True)
class Backoff:
    """When the next attempt may begin, and how long the wait after the next failed attempt is."""

    not_before: float = 0.0
    wait: float = 0.0
    """Length in seconds of the wait that ends at ``not_before``."""
    step: float = FIRST
    """Seconds to wait if the next attempt fails."""

    def at(self, now: float) -> Backoff:
        """Return the backoff at a time. If the clock was set back, no wait is longer than its length."""
        return replace(self, not_before=min(self.not_before, now + self.wait))

    def after(self, wait: float, now: float) -> Backoff:
        """Return the backoff with a wait of ``wait`` seconds from now on."""
        return replace(self, not_before=now + wait, wait=wait)

    def failed(self, now: float, policy: FailurePolicySpec) -> Backoff:
        """Return the backoff after an attempt in which no strategy verified. Each wait doubles, except with priority Safety."""
        step = FIRST if policy.priority == "Safety" else min(2 * self.step, MOST)
        return replace(self.after(self.step, now), step=step)

    def cleared(self, now: float) -> Backoff:
        """Return the backoff after somebody corrected a problem or asked to resume: the next attempt may begin now."""
        return replace(self, not_before=now, step=FIRST)

    def healthy(self) -> Backoff:
        """Return the backoff after the active instance was healthy for long enough: the next failure is a new one."""
        return replace(self, step=FIRST)

    def in_force(self, now: float) -> ActiveLimit | None:
        """Return the wait if it has not ended."""
        return ActiveLimit(until=self.not_before) if now < self.not_before else None
