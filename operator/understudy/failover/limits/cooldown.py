"""The wait after a recovery (limits.cooldown); pure. Times are unix seconds."""

from __future__ import annotations

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.limits.state import ActiveLimit


def length(policy: FailurePolicySpec) -> float:
    """Return the seconds between the end of one recovery and the start of the next. Policies with priority Safety do not wait."""
    return 0.0 if policy.priority == "Safety" else seconds(policy.limits.cooldown)


def in_force(policy: FailurePolicySpec, ended: float | None, now: float) -> ActiveLimit | None:
    """Return the cooldown if it is in force; ``ended`` is the end of the last recovery that succeeded, if there is one.

    That time may come from the clock of another machine: no wait is longer than the cooldown.
    """
    if ended is None:
        return None
    until = min(ended, now) + length(policy)
    return ActiveLimit(f"limits.cooldown of the policy is {policy.limits.cooldown}", until) if now < until else None
