"""From the policy's strategies to those of the failover protocol."""

from __future__ import annotations

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import Progress
from understudy.failover.protocol import Choice
from understudy.failover.strategies import (
    ExecutingFallback,
    InitializedFallback,
    Means,
    Restart,
    Strategy,
    UninitializedFallback,
)


class MissingPool(Strategy):
    """A fallback whose pool isn't there, was never accepted or doesn't serve this workload: never available, and says so."""

    name = "Fallback"

    def __init__(self, pool: str) -> None:
        self.pool = pool

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        """Why it can't be used."""
        return f"FallbackPool {self.pool} isn't there, isn't accepted, or its workloadSelector doesn't select this workload"

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        """Never possible."""
        raise NotAvailable(self.available(means) or "")


def choices(policy: FailurePolicySpec, settings: WorkloadSettings, workload: RobotWorkloadSpec | None) -> list[Choice]:
    """The policy's strategies in order, each with the time it has."""
    bring_up = BringUp.of("bringUp", workload.bring_up if workload else None)
    waiting = [choice.name for choice in settings.pools if choice.readiness != "Uninitialized"]
    readiness = {pool.name: pool.readiness for pool in settings.pools}
    found: list[Choice] = []
    for index, spec in enumerate(policy.strategies):
        pool = spec.pool_ref.name if spec.pool_ref else ""
        strategy: Strategy
        own = BringUp.of(f"strategies[{index}].recovery", spec.recovery)
        # The standbys of one pool aren't another's. What the workload's controller makes waits as the first one's.
        others = [name for name in waiting if name != pool]
        if spec.type == "Restart":
            strategy = Restart(recovery=own or bring_up)
        elif pool not in readiness:
            strategy = MissingPool(pool)
        elif readiness[pool] == "Uninitialized":
            wait_for = seconds(spec.wait_for) if spec.wait_for else 0.0
            kept = next(choice.reserved for choice in settings.pools if choice.name == pool)
            strategy = UninitializedFallback(pool, recovery=own or bring_up, wait_for=wait_for, reserved=kept)
        elif readiness[pool] == "Initialized":
            first = waiting[0] == pool
            strategy = InitializedFallback(pool, recovery=own or bring_up, others=others, with_source=first)
        else:
            # It drives already: only what the policy asks for by name is done to it.
            strategy = ExecutingFallback(pool, recovery=own, others=others, with_source=waiting[0] == pool)
        found.append(Choice(strategy, seconds(spec.verify_within)))
    return found
