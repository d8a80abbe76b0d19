"""From the policy's strategies to those of the failover protocol."""

from __future__ import annotations

from understudy.api.base import seconds
from understudy.api.policies import FailurePolicySpec
from understudy.api.settings import WorkloadSettings
from understudy.mitigation.failover import Choice
from understudy.mitigation.interfaces import Instance, NotAvailable
from understudy.mitigation.progress import Progress
from understudy.mitigation.strategies import ExecutingFallback, Means, Restart, Strategy, UninitializedFallback


class MissingPool(Strategy):
    """A fallback whose pool isn't there or doesn't serve this workload: never available, and says so."""

    name = "Fallback"

    def __init__(self, pool: str) -> None:
        self.pool = pool

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        """Why it can't be used."""
        return f"FallbackPool {self.pool} doesn't exist or its workloadSelector doesn't select this workload"

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        """Never possible."""
        raise NotAvailable(self.available(means) or "")


def choices(policy: FailurePolicySpec, settings: WorkloadSettings) -> list[Choice]:
    """The policy's strategies in order, each with the time it has."""
    readiness = {pool.name: pool.readiness for pool in settings.pools}
    found: list[Choice] = []
    for spec in policy.strategies:
        pool = spec.pool_ref.name if spec.pool_ref else ""
        strategy: Strategy
        if spec.type == "Restart":
            strategy = Restart()
        elif pool not in readiness:
            strategy = MissingPool(pool)
        elif readiness[pool] == "Uninitialized":
            strategy = UninitializedFallback(pool)
        else:
            strategy = ExecutingFallback(pool)
        found.append(Choice(strategy, seconds(spec.verify_within)))
    return found
