"""The fallback to a standby that is configured but does not drive yet."""

from __future__ import annotations

from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import StrategyContext, Unfit
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.steps import enforced_target, make_drivable


class InitializedFallback(ExecutingFallback):
    """A standby that is up and configured: it gets the last state, is brought up behind a closed gate, and is then routed."""

    name = "Fallback/Initialized"
    readiness = "Initialized"

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        if (target := await enforced_target(progress, context)) is not None:
            return target
        candidates = [*self._interrupted_target(progress, context), *self._candidates(context, progress)]
        if not candidates:
            raise NotAvailable(self.available(context, progress) or "no standby is ready")
        return await self._behind_the_gate(candidates, progress, context, within)

    async def make_ready(
        self, progress: Progress, context: StrategyContext, *, within: float, unfit: Unfit
    ) -> Instance:
        target = self._fitting(progress, context, unfit)
        await make_drivable(target, progress, context, self.recovery, within=within)
        return target

    def _interrupted_target(self, progress: Progress, context: StrategyContext) -> list[Instance]:
        """Return the standby that an interrupted run of this recovery began to bring up. It is no longer a candidate."""
        uid = progress.target.uid if progress.target is not None else ""
        return [
            i for i in context.instances.of_workload() if i.uid == uid and i.usable and not progress.has_failed(uid)
        ]
