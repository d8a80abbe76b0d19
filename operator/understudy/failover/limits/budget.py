"""Limits how many recoveries may begin in a moving window of time (limits.budget); pure. Times are unix seconds.

Repeated recoveries that verify and are soon followed by the next one help nobody: they use up pools that other robots share, and a person
has to find the cause.
"""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api.kinds.failure_policy import Budget
from understudy.api.moments import in_words
from understudy.failover.limits.state import ActiveLimit

CLOCKS_DIFFER = 60.0
"""Maximum seconds that the clock of the person who resumes may be ahead of the monitor's clock."""


def left(spent: Sequence[float], now: float, *, recoveries: int, within: float) -> int:
    """Return how many recoveries may begin now; ``spent`` has the start times of earlier ones."""
    return max(0, recoveries - sum(moment > now - within for moment in spent))


def free_from(spent: Sequence[float], *, recoveries: int, within: float) -> float:
    """Return when the next recovery may begin; a time in the past if it may begin now."""
    latest = sorted(spent)[-recoveries:]
    return latest[0] + within if len(latest) == recoveries else 0.0


def counted(spent: Sequence[float], resumed: float | None, now: float) -> list[float]:
    """Return the recoveries that count: those that began after somebody last asked to resume.

    A request from the future is ignored. Otherwise no later recovery would count.
    """
    if resumed is None or resumed > now + CLOCKS_DIFFER:
        return list(spent)
    return [moment for moment in spent if moment > resumed]


def in_force(budget: Budget, spent: Sequence[float], resumed: float | None, now: float) -> ActiveLimit | None:
    """Return the limit if the budget is spent: what the budget allows, and when the next recovery may begin."""
    free = free_from(counted(spent, resumed, now), recoveries=budget.recoveries, within=budget.length)
    return (
        ActiveLimit(f"{budget.words} were made, the next may begin at {in_words(free)}", free) if now < free else None
    )
