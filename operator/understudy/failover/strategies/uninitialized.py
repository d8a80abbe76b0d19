"""The fallback to a pod of a shared pool."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Sequence

from understudy.failover.availability import PODS_CLAIMED, Availability, Pool, Problem, Resources, fallback
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import ClaimLost, ClaimsLost, Instance, NotAvailable, NotVerified
from understudy.failover.pool_queue import YIELD_MOST, Waiter, at_once, before, in_order, left_by, turn
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Strategy, StrategyContext, Unfit
from understudy.failover.strategies.steps import (
    answered_time,
    bring_up_and_open,
    claim_of,
    close,
    committed_target,
    enforced_target,
    join,
    loop_time,
    make_drivable,
    on_other_nodes_first,
    start_answered,
    started,
)

ANSWER_WITHIN = 8.0
"""Seconds within which the agent of a claimed pod must answer, at most a third of the strategy's time. It ran before the claim, so it is
not starting: its node was probably lost, which Kubernetes reports only later. A weak network takes some seconds to admit the monitor."""

REFUSED_AGAIN = 0.25
"""Seconds after which the pods of the pool are requested again if the API server refused."""

CLAIMS_MOST = 2
"""How many pods one attempt claims if their agents do not answer. The cause may be the network of the monitor itself."""


class UninitializedFallback(Strategy):
    """A pod whose processes wait for a robot: claimed, started with this robot's settings behind a closed gate, routed."""

    name = "Fallback/Uninitialized"

    def __init__(self, pool: str, *, recovery: BringUp | None = None, wait_for: float = 0.0, reserved: int = 0) -> None:
        """``wait_for`` is how many seconds to wait if the pool has no pod; ``reserved`` ready pods are kept for other workloads."""
        self.pool, self.recovery, self.wait_for, self.reserved = pool, recovery, wait_for, reserved
        self._lost: set[str] = set()
        """UIDs of pods that other workloads claimed. The watch may not show this yet."""

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        waiting = in_order(context.queue.others(self.pool), self.pool, context.clock())
        pool = Pool(
            readiness="Uninitialized",
            ready=len(self._unclaimed(progress, context)),
            reserved=self.reserved,
            ahead=tuple(waiter.workload for waiter in waiting),
            pod_problem=Problem(PODS_CLAIMED, self._overtaken) if self._lost else None,
        )
        return fallback(self.pool, Resources({self.pool: pool}))

    @property
    def _overtaken(self) -> str:
        return f"every ready pod of FallbackPool {self.pool} was claimed by another workload first"

    def available_as_reported(self, context: StrategyContext) -> str | None:
        return None if context.instances.stocked(self.pool) else f"pool {self.pool} has no pod that it could claim"

    async def refresh(self, context: StrategyContext, progress: Progress | None = None) -> None:
        # If some pods are reserved, or other workloads wait, the number of pods matters.
        if not self.reserved and not context.queue.others(self.pool):
            await context.instances.refresh_unclaimed(self.pool, part=True)
            if self._free(progress, context):
                return
        await context.instances.refresh_unclaimed(self.pool)

    def _unclaimed(self, progress: Progress | None, context: StrategyContext) -> list[Instance]:
        found = (i for i in context.instances.unclaimed(self.pool) if i.uid not in self._lost)
        return [i for i in found if not (progress and progress.has_failed(i.uid))]

    def _free(self, progress: Progress | None, context: StrategyContext) -> list[Instance]:
        """Return the pods that this workload may take if no other workload is ahead of it."""
        unclaimed = self._unclaimed(progress, context)
        return unclaimed[: max(0, len(unclaimed) - self.reserved)]

    async def wait(self, progress: Progress, context: StrategyContext, *, within: float) -> None:
        if committed_target(progress, context) is not None or self._claimed(progress, context) is not None:
            return
        await self._list(progress, context, within=min(ANSWER_WITHIN, within / 3))
        if progress.planned:  # nothing failed: it takes no pod that other robots need
            if (reason := self.available(context, progress)) is not None:
                raise NotAvailable(reason)
            return
        me = self._place(progress, context)
        free = len(self._free(progress, context))
        if at_once(me, context.queue.others(self.pool), free, context.clock()):
            return

        def needless() -> bool:
            context.agents.follow(context.instances.of_workload())  # also those that appear while it waits
            return self._restarted(progress, context) is not None

        try:
            within = max(0.0, me.until - context.clock()) + 2 * YIELD_MOST
            async with asyncio.timeout(within), context.instances.followed(self.pool):
                served = await turn(
                    me,
                    context.queue,
                    free=lambda: [i.uid for i in self._free(progress, context)],
                    clock=context.clock,
                    join=lambda: join(me, progress, context),
                    needless=needless,
                )
        except TimeoutError:  # the API server does not answer, so no pod can be claimed
            served = False
        if served:
            return
        reasons = [
            self.available(context, progress) or f"the monitor could not claim a pod of FallbackPool {self.pool}"
        ]
        if (restarted := self._restarted(progress, context)) is not None and self.wait_for:
            reasons.append(
                f"pod {restarted.name} of the workload itself is ready, so the recovery does not wait for one"
            )
        elif progress.waiting is not None:
            reasons.append(f"no pod became free within {self.wait_for:g} s")
        if progress.waiting is not None:
            context.queue.gave_up(me)
        progress.waiting = None
        raise NotAvailable("; ".join(reasons))

    async def _list(self, progress: Progress, context: StrategyContext, *, within: float) -> None:
        """Request the pods that it could claim. Raises NotAvailable if the API server answers, but not this request, for so long.

        A refusal counts only then: an API server that has just returned may not have loaded the roles yet.
        """
        reason = f"the API server did not list the pods of FallbackPool {self.pool} within {within:.3g} s"
        try:
            async with answered_time(within, progress, context):
                while True:
                    try:
                        return await self.refresh(context, progress)
                    except NotAvailable as refused:
                        reason = str(refused)
                        await asyncio.sleep(REFUSED_AGAIN)
        except TimeoutError:
            raise NotAvailable(reason) from None

    def _restarted(self, progress: Progress, context: StrategyContext) -> Instance | None:
        """Return a usable instance that the workload's own controller created meanwhile: then no pod is waited for."""
        own = (
            i for i in context.instances.of_workload() if i.from_source and i.usable and not progress.has_failed(i.uid)
        )
        return next((i for i in own if (context.agents.is_ready(i)[0] if i.has_agent else i.ready)), None)

    def _place(self, progress: Progress, context: StrategyContext) -> Waiter:
        """Return its place in the queue, which it keeps if the monitor is replaced."""
        since = progress.moments.get("queued", context.clock())
        return Waiter(
            workload=context.queue.workload,
            pool=self.pool,
            priority=context.queue.priority,
            since=since,
            until=since + self.wait_for,
        )

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        if (target := await enforced_target(progress, context)) is not None:
            return target
        end = loop_time() + within
        target = await self._claim_and_start(progress, context, within=min(ANSWER_WITHIN, within / 3))
        await started(target, progress, context)
        await bring_up_and_open(target, progress, context, self.recovery, end=end)
        return target

    async def _claim_and_start(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        """Return a pod whose processes start: the first one, or another one if its agent does not answer. Raises NotVerified."""
        left = CLAIMS_MOST
        while True:
            target = await self._claimed_or_claim(progress, context)
            try:
                await self._start(target, progress, context, within=within)
                return target
            except NotVerified:
                left -= 1
                progress.fail_target()
                await self.refresh(context, progress)
                if not left or not self._free(progress, context):
                    progress.target = PodIdentity(name=target.name, uid=target.uid)
                    raise

    async def _start(self, target: Instance, progress: Progress, context: StrategyContext, *, within: float) -> None:
        """Start the processes of a claimed pod. Raises NotVerified if its agent does not answer."""
        progress.moments["claimed"] = context.clock()
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", context.clock())
        waited, progress.waiting = progress.waiting, None
        context.save(progress)
        if waited is not None:
            context.queue.served(waited, target.name)
            # Other workloads in the queue learn from the gate that this one no longer waits. The start comes after it: an agent is not
            # commanded by a decision of an epoch that has passed.
            await context.gate.commit(None, progress)
        await start_answered(target, context, within=within)

    async def make_ready(
        self, progress: Progress, context: StrategyContext, *, within: float, unfit: Unfit
    ) -> Instance:
        end = loop_time() + within
        await context.instances.refresh_unclaimed(self.pool)
        if (reason := self.available(context, progress)) is not None:
            raise NotAvailable(reason)
        reasons = [(i, unfit(i)) for i in self._free(progress, context)]
        if reasons and all(reason is not None for _, reason in reasons):
            raise NotAvailable("; ".join(f"{i.name} {reason}" for i, reason in reasons))
        target = await self._claim(progress, context, unfit)
        if target is None:
            raise NotAvailable(self._overtaken)
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.moments["claimed"] = context.clock()
        await context.agents.start(target)
        await started(target, progress, context)
        await make_drivable(target, progress, context, self.recovery, within=end - loop_time())
        return target

    def _claimed(self, progress: Progress, context: StrategyContext) -> Instance | None:
        """Return the pod that an interrupted run of this recovery claimed."""
        claim = claim_of(progress, context)
        found = (i for i in context.instances.of_workload() if i.claim == claim and i.usable)
        return next((i for i in found if not progress.has_failed(i.uid)), None)

    async def _claimed_or_claim(self, progress: Progress, context: StrategyContext) -> Instance:
        if (claimed := self._claimed(progress, context)) is not None:
            await close(progress, context)
            return claimed
        context.save(progress)  # the claim has its id, so that a new monitor finds the pod
        # Wait for both even if the claim fails: the next commit needs the epoch of this one.
        closing, target = await asyncio.gather(
            close(progress, context), self._claim(progress, context), return_exceptions=True
        )
        if isinstance(closing, BaseException):
            raise closing
        if isinstance(target, BaseException):
            raise target
        if target is None:
            raise ClaimsLost(self._overtaken)
        return target

    async def _claim(
        self, progress: Progress, context: StrategyContext, unfit: Unfit = lambda instance: None
    ) -> Instance | None:
        """Claim one of the pods that it may take; return None if other workloads claimed all of them first."""
        while candidates := [i for i in self._candidates(progress, context) if unfit(i) is None]:
            try:
                return await context.instances.claim(candidates[0], claim_of(progress, context))
            except ClaimLost:
                # Other workloads claim too. A read is cheaper than another claim that is lost.
                self._lost.add(candidates[0].uid)
                await self.refresh(context, progress)
        return None

    def _candidates(self, progress: Progress, context: StrategyContext) -> Sequence[Instance]:
        """Return the pods that it may take, in the order in which it tries to claim them."""
        others = context.queue.others(self.pool)
        ahead = before(self._place(progress, context), others, context.clock())
        candidates = on_other_nodes_first(left_by(ahead, self._free(progress, context)), progress, context)
        if progress.waiting is None and not others:
            # If many robots fail at once, each starts with another pod: otherwise all but one would lose the race for the first
            # pod, and again for the second. Workloads that wait have an order instead.
            return on_other_nodes_first(apart(candidates, context.workload_uid), progress, context)
        return candidates


def apart(pods: Sequence[Instance], workload_uid: str) -> list[Instance]:
    """Return pods in an order that differs between workloads and is stable for each (rendezvous hashing)."""
    return sorted(pods, key=lambda pod: hashlib.sha256(f"{workload_uid}/{pod.uid}".encode()).digest())
