"""The restart: a new pod of the workload itself."""

from __future__ import annotations

from understudy.failover.availability import Availability, Resources, restart
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotAvailable, NotVerified
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Strategy, StrategyContext, Unfit
from understudy.failover.strategies.steps import (
    bring_up_and_open,
    close,
    enforced_target,
    loop_time,
    make_drivable,
    started,
)


class Restart(Strategy):
    """The pod is deleted, and the workload's own controller starts another one."""

    name = "Restart"
    makes_pod = True

    def __init__(self, *, recovery: BringUp | None = None) -> None:
        self.recovery = recovery

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        # A pod that does not start may start the next time: during a recovery the last resort is tried in any case.
        return restart(Resources())

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        if (target := await enforced_target(progress, context)) is not None:
            return target
        end = loop_time() + within
        await close(progress, context)
        for instance in context.instances.of_workload():
            # The kubelet restarts a crash-looping container less and less often; a new pod starts at once.
            if instance.from_source and instance.crashing and not context.agents.is_ready(instance)[0]:
                progress.fail(PodIdentity(name=instance.name, uid=instance.uid))
        await context.instances.replace([i for i in context.instances.of_workload() if progress.has_failed(i.uid)])
        target = await context.instances.wait(lambda i: i.from_source and i.usable and not progress.has_failed(i.uid))
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", context.clock())
        context.save(progress)
        await started(target, progress, context)
        await bring_up_and_open(target, progress, context, self.recovery, end=end)
        return target

    async def make_ready(
        self, progress: Progress, context: StrategyContext, *, within: float, unfit: Unfit
    ) -> Instance:
        """Prepare a pod of the workload's own controller. Possible only while a pod of a pool is active."""
        end, active = loop_time() + within, context.gate.state.active_uid
        instances = context.instances.of_workload()
        if any(i.from_source for i in instances if i.uid == active):
            raise NotAvailable(
                "it cannot be used for a planned switchover, because the Deployment, StatefulSet or ReplicaSet of the workload runs only "
                "one pod, and this pod is active"
            )
        own = [i for i in instances if i.from_source and i.usable and not progress.has_failed(i.uid)]
        if reasons := [f"{i.name} {reason}" for i in own if (reason := unfit(i)) is not None]:
            raise NotAvailable("; ".join(reasons))
        if not own:
            await context.instances.replace([])
        target = await context.instances.wait(lambda i: i.from_source and i.usable and not progress.has_failed(i.uid))
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        if (reason := unfit(target)) is not None:
            raise NotVerified(f"{target.name} {reason}")
        if not own:
            await started(target, progress, context)
        # A pod that has run for a while was brought up already (monitor/act/instances/standby_lifecycle.py).
        standing = bool(own) and context.agents.is_ready(target)[0]
        await make_drivable(target, progress, context, None if standing else self.recovery, within=end - loop_time())
        return target
