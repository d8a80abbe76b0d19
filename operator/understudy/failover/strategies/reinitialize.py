"""The reaction to the recovery of a dependency: the active instance is brought up again."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api.protocol.kept_state import KeptState
from understudy.failover.availability import INSTANCE_GONE, Availability
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import Strategy, StrategyContext
from understudy.failover.strategies.steps import (
    bring_up_and_open,
    close,
    enforced_target,
    kept,
    loop_time,
)


class Reinitialize(Strategy):
    """The active instance stays and is brought up again behind a closed gate, because a workload that it depends on was replaced."""

    def __init__(self, name: str, procedures: Sequence[BringUp]) -> None:
        """``procedures`` run one after the other; there is at least one."""
        self.name, self._procedures = name, procedures

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        if progress is None or self._target_instance(progress, context) is None:
            return Availability(False, INSTANCE_GONE, "the instance that was active is gone")
        return Availability(True)

    def _target_instance(self, progress: Progress, context: StrategyContext) -> Instance | None:
        uid = progress.target.uid if progress.target is not None else ""
        found = (i for i in context.instances.of_workload() if i.uid == uid and i.usable)
        return next((i for i in found if not progress.has_failed(i.uid)), None)

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        if (target := await enforced_target(progress, context)) is not None:
            return target
        target, end = self._target_instance(progress, context), loop_time() + within
        if target is None:
            raise NotAvailable(self.available(context, progress) or "")
        await close(progress, context)
        progress.charge("cluster", context.clock())
        context.save(progress)
        *before, last = self._procedures
        for procedure in before:
            state = kept(progress, context) if procedure.restores_state else KeptState()
            await context.agents.bring_up(target, procedure, within=procedure.within, state=state)
        await bring_up_and_open(target, progress, context, last, end=end)
        return target
