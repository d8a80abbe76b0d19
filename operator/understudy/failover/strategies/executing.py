"""The fallback to a standby that runs in full: one patch of the gate puts it in control."""

from __future__ import annotations

from collections.abc import Collection

from understudy.failover.availability import STANDBY_NOT_READY, Availability, Pool, Problem, Resources, fallback
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Strategy, StrategyContext, Unfit
from understudy.failover.strategies.steps import (
    bring_up_and_open,
    close,
    close_and_see,
    committed_target,
    loop_time,
    make_drivable,
    on_other_nodes_first,
    open_for,
    wait_enforced,
)


class ExecutingFallback(Strategy):
    """A standby that runs in full and receives everything; the gate drops its outputs. One patch makes it active."""

    name = "Fallback/Executing"
    readiness = "Executing"
    has_own_instance = True

    def __init__(
        self,
        pool: str,
        *,
        recovery: BringUp | None = None,
        others: Collection[str] = (),
        with_source: bool = True,
        breaks_first: bool = False,
    ) -> None:
        """Exclude the standbys of the pools ``others``, and those of the workload's own controller unless ``with_source``.

        With ``breaks_first``, no packet of the former instance passes the gate any more when it is opened for the standby.
        """
        self.pool, self.recovery, self.breaks_first = pool, recovery, breaks_first
        self._others, self.with_source = frozenset(others), with_source

    def _is_standby(self, instance: Instance) -> bool:
        return instance.pool not in self._others and (self.with_source or not instance.from_source)

    def _candidates(self, context: StrategyContext, progress: Progress | None) -> list[Instance]:
        active = context.gate.state.active_uid
        return [
            i
            for i in context.instances.of_workload()
            if i.usable
            and i.has_agent
            and not i.held
            and i.uid != active
            and not (progress and progress.has_failed(i.uid))
            and self._is_standby(i)
            and context.agents.is_ready(i)[0]
        ]

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        ready = len(self._candidates(context, progress))
        pool = Pool(self.readiness, ready=ready, pod_problem=None if ready else self._not_ready(context))
        return fallback(self.pool, Resources({self.pool: pool}))

    def _not_ready(self, context: StrategyContext) -> Problem:
        """Return why the standbys are not ready, by their agents."""
        active = context.gate.state.active_uid
        others = [
            i for i in context.instances.of_workload() if i.uid != active and not i.terminating and self._is_standby(i)
        ]
        text = "; ".join(f"{i.name}: {context.agents.is_ready(i)[1] or 'not running'}" for i in others)
        return Problem(STANDBY_NOT_READY, text or f"pool {self.pool} has no standby for this workload")

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        target = committed_target(progress, context)
        if target is None:
            candidates = self._candidates(context, progress)
            if not candidates:
                if self.recovery is None:
                    progress.target = None  # an earlier monitor had chosen it, and nothing was done to it
                raise NotAvailable(self.available(context, progress) or "no standby is ready")
            if self.recovery is not None:
                return await self._behind_the_gate(candidates, progress, context, within)
            # Readers with exclusive ownership may follow the admitted standby already. Otherwise a pod of the pool comes first:
            # the workload's own controller may be about to replace its pod.
            target = self._best(candidates, progress, context, context.gate.state.admitted_uid)
            if self.breaks_first:
                await close_and_see(target, progress, context, within=within)
            await open_for(target, progress, context)
        await wait_enforced(target, progress, context)
        return target

    async def make_ready(
        self, progress: Progress, context: StrategyContext, *, within: float, unfit: Unfit
    ) -> Instance:
        target = self._fitting(progress, context, unfit)
        if self.recovery is not None:
            await make_drivable(target, progress, context, self.recovery, within=within)
        return target

    def _best(
        self, candidates: Collection[Instance], progress: Progress, context: StrategyContext, first: str = ""
    ) -> Instance:
        """Return the candidate with the UID ``first``, or the best one.

        A pod that Kubernetes reports as not ready is probably on a node that is lost or about to be, although its agent answers.
        """
        ordered = sorted(candidates, key=lambda i: (not i.ready, i.pool != self.pool, i.created, i.name))
        return min(on_other_nodes_first(ordered, progress, context), key=lambda i: i.uid != first)

    def _fitting(self, progress: Progress, context: StrategyContext, unfit: Unfit) -> Instance:
        """Return the best standby for a planned switchover. Raises NotAvailable."""
        candidates = self._candidates(context, progress)
        if not candidates:
            raise NotAvailable(self.available(context, progress) or "no standby is ready")
        reasons = [(i, unfit(i)) for i in candidates]
        if fitting := [i for i, reason in reasons if reason is None]:
            return self._best(fitting, progress, context, context.gate.state.admitted_uid)
        raise NotAvailable("; ".join(f"{i.name} {reason}" for i, reason in reasons))

    async def _behind_the_gate(
        self, candidates: list[Instance], progress: Progress, context: StrategyContext, within: float
    ) -> Instance:
        """Close the gate, bring a standby up, open the gate for it."""
        end = loop_time() + within
        target_uid = progress.target.uid if progress.target is not None else ""  # by an earlier monitor
        target = self._best(candidates, progress, context, target_uid)
        await close(progress, context)
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", context.clock())
        context.save(progress)
        await bring_up_and_open(target, progress, context, self.recovery, end=end)
        return target
