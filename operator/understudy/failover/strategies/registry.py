"""Converts the strategies of a policy to those of the failover protocol.

To add a readiness level, write its strategy and enter it in ``FALLBACKS``; to add a strategy, enter it in ``choices``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.failure_policy import Strategy as StrategySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.availability import NO_POOL, Availability
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import Choice, Strategy, StrategyContext
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback


class UnknownPool(Strategy):
    """A fallback to a pool that does not exist, was never accepted or does not serve this workload: it is never available."""

    name = "Fallback"

    def __init__(self, pool: str) -> None:
        self.pool = pool

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        text = f"FallbackPool {self.pool} does not exist, is not accepted, or its workloadSelector does not select this workload"
        return Availability(False, NO_POOL, text)

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        raise NotAvailable(self.available(context) or "")


@dataclass(frozen=True)
class Fallback:
    """The parameters of a fallback."""

    spec: StrategySpec
    pool: PoolChoice
    own: BringUp | None
    """The procedure that the strategy names."""
    bring_up: BringUp | None
    """The procedure that the strategy names, or else the procedure of the workload."""
    waiting: tuple[str, ...]
    """The pools of the policy whose standbys run for this robot already, in order."""

    is_at_robot: bool = False
    """As ``Gate.is_at_robot``: the gate gives the robot from one instance to another at once."""

    @property
    def breaks_first(self) -> bool:
        """Whether the former instance must be off the robot before another one gets it."""
        return self.spec.handover == "BreakBeforeMake" and not self.is_at_robot

    @property
    def others(self) -> list[str]:
        """The other pools in ``waiting``. Their standbys do not belong to this pool."""
        return [name for name in self.waiting if name != self.pool.name]

    @property
    def with_source(self) -> bool:
        """Whether this pool includes the standbys of the workload's own controller. Only the first pool does."""
        return self.waiting[0] == self.pool.name


def _uninitialized(fallback: Fallback) -> Strategy:
    wait_for = seconds(fallback.spec.wait_for) if fallback.spec.wait_for else 0.0
    pool = fallback.pool
    return UninitializedFallback(pool.name, recovery=fallback.bring_up, wait_for=wait_for, reserved=pool.reserved)


def _initialized(fallback: Fallback) -> Strategy:
    return InitializedFallback(
        fallback.pool.name, recovery=fallback.bring_up, others=fallback.others, with_source=fallback.with_source
    )


def _executing(fallback: Fallback) -> Strategy:
    # It runs in full already: only the procedure that the strategy names is run on it.
    return ExecutingFallback(
        fallback.pool.name,
        recovery=fallback.own,
        others=fallback.others,
        with_source=fallback.with_source,
        breaks_first=fallback.breaks_first,
    )


FALLBACKS: Mapping[str, Callable[[Fallback], Strategy]] = {
    "Uninitialized": _uninitialized,
    "Initialized": _initialized,
    "Executing": _executing,
}
"""The fallback for each readiness of a pool."""


def choices(policy: FailurePolicySpec, settings: WorkloadSettings, workload: RobotWorkloadSpec | None) -> list[Choice]:
    """Return the strategies of the policy in order, each with its time limit."""
    usual = BringUp.of("bringUp", workload.bring_up if workload else None)
    pools = {pool.name: pool for pool in settings.pools}
    waiting = tuple(pool.name for pool in settings.pools if pool.level.has_standbys)
    found: list[Choice] = []
    for index, spec in enumerate(policy.strategies):
        own = BringUp.of(f"strategies[{index}].recovery", spec.recovery)
        strategy: Strategy
        if spec.type == "Restart":
            strategy = Restart(recovery=own or usual)
        else:
            name = spec.pool_ref.name if spec.pool_ref else ""
            if (pool := pools.get(name)) is None:
                strategy = UnknownPool(name)
            else:
                is_at_robot = workload is not None and workload.gate.is_at_robot
                strategy = FALLBACKS[pool.readiness](Fallback(spec, pool, own, own or usual, waiting, is_at_robot))
        found.append(Choice(strategy, seconds(spec.verify_within)))
    return found
