"""The mitigation strategies: each knows how to put one understudy in control, and can be repeated from any step.

Every strategy fences before it routes: either both in one commit (an executing standby), or the gate closes first, the
understudy is brought up behind it, and the gate then opens for it (DESIGN: the failover protocol, step 4).
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.api.protocol.kept_state import KeptState
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import (
    Agents,
    ClaimLost,
    Gate,
    Instance,
    Instances,
    NotAvailable,
    NotVerified,
    Outputs,
    Overtaken,
)
from understudy.failover.pool_queue import YIELD_MOST, Queue, Waiter, at_once, before, in_order, left_by, turn
from understudy.failover.progress import PodIdentity, Progress

_logger = logging.getLogger(__name__)

ENFORCED_WITHIN = 1.0
"""Seconds to wait for packets to prove that the gate is open, before going by what arrives at the gated readers."""

MOMENT = 0.1
"""Seconds that a step gets at least, so that it can say what it failed by."""

ANSWER = 1.0
"""Seconds before the end of a strategy's time at which its procedure ends at the latest, so that it is told at which leaf; of
a short time no more than a quarter."""

PROBE_SECONDS = 2.0
"""How long probes are asked for around a commit."""


Unfit = Callable[[Instance], str | None]
"""Why an instance may not take over in a planned switchover, such as for the node that it runs on; None where it may."""


@dataclass(frozen=True)
class Means:
    """What a strategy works with."""

    gate: Gate
    instances: Instances
    agents: Agents
    outputs: Outputs
    queue: Queue
    clock: Callable[[], float]
    save: Callable[[Progress], None]
    workload_uid: str
    kept: Callable[[float], KeptState] = lambda onset: KeptState()
    """The state that is given to the instance that takes over after a failure that began then (unix seconds)."""
    restore_within: float = 5.0
    """Seconds that giving it may take."""
    holds: Callable[[Strategy], str | None] = lambda strategy: None
    """Why a strategy isn't to be tried now although it could be; None where it is."""


class Strategy(ABC):
    """One way to put an instance in control."""

    name: str
    pool: str = ""
    standing = False
    """Whether the instance runs for this robot already, so that trying it takes nothing from others."""

    @abstractmethod
    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        """Bring an understudy to where it can drive, and open the gate for it. Raises NotAvailable."""

    async def make_ready(self, progress: Progress, means: Means, *, within: float, unfit: Unfit) -> Instance:
        """Bring an understudy to where it can drive while another instance drives, and leave the gate alone.

        One to which something is done is the progress's target before that. Raises NotAvailable, NotVerified.
        """
        raise NotAvailable(f"{self.name} can't prepare an understudy while another instance drives")

    async def wait(self, progress: Progress, means: Means) -> None:
        """Wait until what it needs is there, for as long as the policy says. Raises NotAvailable."""
        return

    @abstractmethod
    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        """Why it couldn't be used now, or None if it could."""

    def outlook(self, means: Means) -> str | None:
        """The same by what is known without asking, while nothing has failed."""
        return self.available(means)

    async def look(self, means: Means, progress: Progress | None = None) -> None:
        """Look at what it goes by, where that isn't known without asking."""
        return


class ExecutingFallback(Strategy):
    """A standby that runs in full, receives everything and whose outputs are gated: one patch puts it in control."""

    name = "Fallback/Executing"
    standing = True

    def __init__(
        self, pool: str, *, recovery: BringUp | None = None, others: Collection[str] = (), with_source: bool = True
    ) -> None:
        """``others`` are the pools whose standbys wait at another readiness; those that the workload's own controller makes
        count ``with_source``.
        """
        self.pool, self._recovery = pool, recovery
        self._others, self._with_source = frozenset(others), with_source

    def _is_standby(self, instance: Instance) -> bool:
        return instance.pool not in self._others and (self._with_source or not instance.from_source)

    def _candidates(self, means: Means, progress: Progress | None) -> list[Instance]:
        active = means.gate.state.active_uid
        return [
            i
            for i in means.instances.of_workload()
            if i.usable
            and i.has_agent
            and not i.held
            and i.uid != active
            and not (progress and progress.has_failed(i.uid))
            and self._is_standby(i)
            and means.agents.is_ready(i)[0]
        ]

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        if self._candidates(means, progress):
            return None
        active = means.gate.state.active_uid
        others = [
            i for i in means.instances.of_workload() if i.uid != active and not i.terminating and self._is_standby(i)
        ]
        if not others:
            return f"pool {self.pool} has no standby for this workload"
        return "; ".join(f"{i.name}: {means.agents.is_ready(i)[1] or 'not running'}" for i in others)

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        target = _committed_target(progress, means)
        if target is None:
            candidates = self._candidates(means, progress)
            if not candidates:
                raise NotAvailable(self.available(means, progress) or "no standby is ready")
            if self._recovery is not None:
                return await self._behind_the_gate(candidates, progress, means, within)
            # The one that readers with exclusive ownership may be heeding already; else one of the pool's own first: the
            # workload's controller may be about to replace its pod.
            target = self._best(candidates, means)
            await open_for(target, progress, means)
        await wait_enforced(target, progress, means)
        return target

    async def make_ready(self, progress: Progress, means: Means, *, within: float, unfit: Unfit) -> Instance:
        target = self._fitting(progress, means, unfit)
        if self._recovery is not None:
            await _make_ready(target, progress, means, self._recovery, within=within)
        return target

    def _best(self, candidates: Collection[Instance], means: Means) -> Instance:
        admitted = means.gate.state.admitted_uid
        return min(candidates, key=lambda i: (i.uid != admitted, i.pool != self.pool, i.created, i.name))

    def _fitting(self, progress: Progress, means: Means, unfit: Unfit) -> Instance:
        """The best standby that may take over as planned. Raises NotAvailable."""
        candidates = self._candidates(means, progress)
        if not candidates:
            raise NotAvailable(self.available(means, progress) or "no standby is ready")
        reasons = [(i, unfit(i)) for i in candidates]
        if fitting := [i for i, reason in reasons if reason is None]:
            return self._best(fitting, means)
        raise NotAvailable("; ".join(f"{i.name} {reason}" for i, reason in reasons))

    async def _behind_the_gate(
        self, candidates: list[Instance], progress: Progress, means: Means, within: float
    ) -> Instance:
        """Close the gate, bring a standby up, open the gate for it."""
        end = _now() + within
        begun = progress.target.uid if progress.target is not None else ""  # by a monitor that is gone
        target = min(candidates, key=lambda i: (i.uid != begun, i.pool != self.pool, i.created, i.name))
        await _close(progress, means)
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", means.clock())
        means.save(progress)
        await _bring_up(target, progress, means, self._recovery, end=end)
        return target


class InitializedFallback(ExecutingFallback):
    """A standby that is up and configured: given the last state and brought to driving behind a closed gate, then routed."""

    name = "Fallback/Initialized"

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        target = _committed_target(progress, means)
        if target is not None:
            await wait_enforced(target, progress, means)
            return target
        candidates = [*self._begun(progress, means), *self._candidates(means, progress)]
        if not candidates:
            raise NotAvailable(self.available(means, progress) or "no standby is ready")
        return await self._behind_the_gate(candidates, progress, means, within)

    async def make_ready(self, progress: Progress, means: Means, *, within: float, unfit: Unfit) -> Instance:
        target = self._fitting(progress, means, unfit)
        await _make_ready(target, progress, means, self._recovery, within=within)
        return target

    def _begun(self, progress: Progress, means: Means) -> list[Instance]:
        """The standby that an interrupted run of this recovery was bringing up, which isn't one any more."""
        uid = progress.target.uid if progress.target is not None else ""
        return [i for i in means.instances.of_workload() if i.uid == uid and i.usable and not progress.has_failed(uid)]


class UninitializedFallback(Strategy):
    """A pod whose processes wait for a robot: claimed, started with this robot's settings behind a closed gate, routed."""

    name = "Fallback/Uninitialized"

    def __init__(self, pool: str, *, recovery: BringUp | None = None, wait_for: float = 0.0, reserved: int = 0) -> None:
        """``wait_for`` is how many seconds a pod is waited for where the pool has none; of those that are ready it keeps
        ``reserved`` for others.
        """
        self.pool, self._recovery, self._wait_for, self._reserved = pool, recovery, wait_for, reserved
        self._lost: set[str] = set()
        """UIDs of pods that others have claimed, which the watch may not have told yet."""

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        free = self._free(progress, means)
        waiting = in_order(means.queue.others(self.pool), self.pool, means.clock())
        if len(free) > len(waiting):
            return None
        if free:
            return f"pool {self.pool} has {len(free)} ready, for which others wait: {', '.join(w.workload for w in waiting[:3])}"
        if unclaimed := len(self._unclaimed(progress, means)):
            return f"pool {self.pool} keeps its last {unclaimed} ready for workloads with a higher poolPriority"
        if self._lost:
            return f"every ready pod of pool {self.pool} was claimed by another workload first"
        return f"pool {self.pool} has no unclaimed pod that is ready"

    def outlook(self, means: Means) -> str | None:
        return None if means.instances.stocked(self.pool) else f"pool {self.pool} has no pod that it could claim"

    async def look(self, means: Means, progress: Progress | None = None) -> None:
        # Where some are kept for others, or others wait, it matters how many there are.
        if not self._reserved and not means.queue.others(self.pool):
            await means.instances.look(self.pool, part=True)
            if self._free(progress, means):
                return
        await means.instances.look(self.pool)

    def _unclaimed(self, progress: Progress | None, means: Means) -> list[Instance]:
        found = (i for i in means.instances.unclaimed(self.pool) if i.uid not in self._lost)
        return [i for i in found if not (progress and progress.has_failed(i.uid))]

    def _free(self, progress: Progress | None, means: Means) -> list[Instance]:
        """The pods that this workload may take, as far as nobody is before it."""
        unclaimed = self._unclaimed(progress, means)
        return unclaimed[: max(0, len(unclaimed) - self._reserved)]

    async def wait(self, progress: Progress, means: Means) -> None:
        if _committed_target(progress, means) is not None or self._claimed(progress, means) is not None:
            return
        await self.look(means, progress)
        if progress.planned:  # nothing failed: it takes no pod that others need
            if (reason := self.available(means, progress)) is not None:
                raise NotAvailable(reason)
            return
        me = self._place(progress, means)
        free = len(self._free(progress, means))
        if at_once(me, means.queue.others(self.pool), free, means.clock()):
            return

        def needless() -> bool:
            means.agents.follow(means.instances.of_workload())  # those that come while it waits too
            return self._restarted(progress, means) is not None

        try:
            within = max(0.0, me.until - means.clock()) + 2 * YIELD_MOST
            async with asyncio.timeout(within), means.instances.followed(self.pool):
                served = await turn(
                    me,
                    means.queue,
                    free=lambda: [i.uid for i in self._free(progress, means)],
                    clock=means.clock,
                    join=lambda: _join(me, progress, means),
                    needless=needless,
                )
        except TimeoutError:  # the API server is away, and so is every pod
            served = False
        if served:
            return
        told = [self.available(means, progress) or f"pool {self.pool} could not be claimed from"]
        if (restarted := self._restarted(progress, means)) is not None and self._wait_for:
            told.append(f"{restarted.name} is up already")
        elif progress.waiting is not None:
            told.append(f"it got none in {self._wait_for:g} s")
        if progress.waiting is not None:
            means.queue.gave_up(me)
        progress.waiting = None
        raise NotAvailable("; ".join(told))

    def _restarted(self, progress: Progress, means: Means) -> Instance | None:
        """An instance that the workload's own controller made meanwhile, and that could drive: then no other is waited for."""
        own = (
            i for i in means.instances.of_workload() if i.from_source and i.usable and not progress.has_failed(i.uid)
        )
        return next((i for i in own if (means.agents.is_ready(i)[0] if i.has_agent else i.ready)), None)

    def _place(self, progress: Progress, means: Means) -> Waiter:
        """Its place among those that wait: since it began to, also where an earlier monitor did."""
        since = progress.moments.get("queued", means.clock())
        return Waiter(
            workload=means.queue.workload,
            pool=self.pool,
            priority=means.queue.priority,
            since=since,
            until=since + self._wait_for,
        )

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        target = _committed_target(progress, means)
        if target is not None:
            await wait_enforced(target, progress, means)
            return target
        end = _now() + within
        target = await self._claimed_or_claim(progress, means)
        progress.moments["claimed"] = means.clock()
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", means.clock())
        waited, progress.waiting = progress.waiting, None
        means.save(progress)
        if waited is None:
            await means.agents.start(target)
        else:
            means.queue.served(waited, target.name)
            # Who waits too learns from the gate that this one doesn't any more; meanwhile the processes start.
            await _both(means.agents.start(target), means.gate.commit(None, progress))
        await _started(target, progress, means)
        await _bring_up(target, progress, means, self._recovery, end=end)
        return target

    async def make_ready(self, progress: Progress, means: Means, *, within: float, unfit: Unfit) -> Instance:
        end = _now() + within
        await means.instances.look(self.pool)
        if (reason := self.available(means, progress)) is not None:
            raise NotAvailable(reason)
        reasons = [(i, unfit(i)) for i in self._free(progress, means)]
        if reasons and all(reason is not None for _, reason in reasons):
            raise NotAvailable("; ".join(f"{i.name} {reason}" for i, reason in reasons))
        target = await self._claim(progress, means, unfit)
        if target is None:
            raise NotAvailable(f"every ready pod of pool {self.pool} was claimed by another workload first")
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.moments["claimed"] = means.clock()
        await means.agents.start(target)
        await _started(target, progress, means)
        await _make_ready(target, progress, means, self._recovery, within=end - _now())
        return target

    def _claimed(self, progress: Progress, means: Means) -> Instance | None:
        """The pod that an interrupted run of this recovery claimed."""
        claim = _claim_of(progress, means)
        found = (i for i in means.instances.of_workload() if i.claim == claim and i.usable)
        return next((i for i in found if not progress.has_failed(i.uid)), None)

    async def _claimed_or_claim(self, progress: Progress, means: Means) -> Instance:
        if (claimed := self._claimed(progress, means)) is not None:
            await _close(progress, means)
            return claimed
        means.save(progress)  # the claim bears its id: found again by whoever goes on
        # Both are waited for, whatever becomes of the claim: who commits next must know of the gate's closing.
        closing, target = await asyncio.gather(
            _close(progress, means), self._claim(progress, means), return_exceptions=True
        )
        if isinstance(closing, BaseException):
            raise closing
        if isinstance(target, BaseException):
            raise target
        if target is None:
            raise Overtaken(f"every ready pod of pool {self.pool} was claimed by another workload first")
        return target

    async def _claim(self, progress: Progress, means: Means, unfit: Unfit = lambda instance: None) -> Instance | None:
        """One of the pods that it may take; None where others were first with all of them."""
        while candidates := [i for i in self._candidates(progress, means) if unfit(i) is None]:
            try:
                return await means.instances.claim(candidates[0], _claim_of(progress, means))
            except ClaimLost:
                # Others are at it too, so the next one is gone as well by now, or not: to look is no write, to lose is.
                self._lost.add(candidates[0].uid)
                await self.look(means, progress)
        return None

    def _candidates(self, progress: Progress, means: Means) -> Sequence[Instance]:
        """The pods that it may take, in the order in which it tries to."""
        others = means.queue.others(self.pool)
        ahead = before(self._place(progress, means), others, means.clock())
        candidates = left_by(ahead, self._free(progress, means))
        if progress.waiting is None and not others:
            # Where many fail at once, each begins with another pod: all but one would lose the race for the first one, and
            # for the second. Those that wait have an order instead.
            return apart(candidates, means.workload_uid)
        return candidates


def apart(pods: Sequence[Instance], workload_uid: str) -> list[Instance]:
    """Pods in an order that is another for each workload, and always the same for one (rendezvous hashing)."""
    return sorted(pods, key=lambda pod: hashlib.sha256(f"{workload_uid}/{pod.uid}".encode()).digest())


class Restart(Strategy):
    """The pod is deleted and the workload's own controller starts another one."""

    name = "Restart"

    def __init__(self, *, recovery: BringUp | None = None) -> None:
        self._recovery = recovery

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        return None

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        target = _committed_target(progress, means)
        if target is not None:
            await wait_enforced(target, progress, means)
            return target
        end = _now() + within
        await _close(progress, means)
        for instance in means.instances.of_workload():
            # One that ends again and again is started less and less often; a new one begins at once.
            if instance.from_source and instance.crashing and not means.agents.is_ready(instance)[0]:
                progress.fail(PodIdentity(name=instance.name, uid=instance.uid))
        await means.instances.replace([i for i in means.instances.of_workload() if progress.has_failed(i.uid)])
        target = await means.instances.wait(lambda i: i.from_source and i.usable and not progress.has_failed(i.uid))
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        progress.charge("cluster", means.clock())
        means.save(progress)
        await _started(target, progress, means)
        await _bring_up(target, progress, means, self._recovery, end=end)
        return target

    async def make_ready(self, progress: Progress, means: Means, *, within: float, unfit: Unfit) -> Instance:
        """Only where a pool's pod drives: the workload's own controller then has one of its own run too."""
        end, active = _now() + within, means.gate.state.active_uid
        instances = means.instances.of_workload()
        if any(i.from_source for i in instances if i.uid == active):
            raise NotAvailable("its own controller runs one pod, which drives: another can't be started beside it")
        own = [i for i in instances if i.from_source and i.usable and not progress.has_failed(i.uid)]
        if reasons := [f"{i.name} {reason}" for i in own if (reason := unfit(i)) is not None]:
            raise NotAvailable("; ".join(reasons))
        if not own:
            await means.instances.replace([])
        target = await means.instances.wait(lambda i: i.from_source and i.usable and not progress.has_failed(i.uid))
        progress.target = PodIdentity(name=target.name, uid=target.uid)
        if (reason := unfit(target)) is not None:
            raise NotVerified(f"{target.name} {reason}")
        if not own:
            await _started(target, progress, means)
        # What has run for a while was brought up already (monitor/act/standby_lifecycle.py).
        standing = bool(own) and means.agents.is_ready(target)[0]
        await _make_ready(target, progress, means, None if standing else self._recovery, within=end - _now())
        return target


class Reinitialize(Strategy):
    """The instance in control stays, and is brought up again behind a closed gate: something that it depends on was replaced."""

    def __init__(self, name: str, procedures: Sequence[BringUp]) -> None:
        """``procedures`` are done one after the other; there is one at least."""
        self.name, self._procedures = name, procedures

    def available(self, means: Means, progress: Progress | None = None) -> str | None:
        if progress is None or self._standing(progress, means) is None:
            return "the instance that was in control is gone"
        return None

    def _standing(self, progress: Progress, means: Means) -> Instance | None:
        uid = progress.target.uid if progress.target is not None else ""
        found = (i for i in means.instances.of_workload() if i.uid == uid and i.usable)
        return next((i for i in found if not progress.has_failed(i.uid)), None)

    async def prepare(self, progress: Progress, means: Means, *, within: float) -> Instance:
        target = _committed_target(progress, means)
        if target is not None:
            await wait_enforced(target, progress, means)
            return target
        target, end = self._standing(progress, means), _now() + within
        if target is None:
            raise NotAvailable(self.available(means, progress) or "")
        await _close(progress, means)
        progress.charge("cluster", means.clock())
        means.save(progress)
        *before, last = self._procedures
        for procedure in before:
            state = kept(progress, means) if procedure.restores_state else KeptState()
            await means.agents.bring_up(target, procedure, within=procedure.within, state=state)
        await _bring_up(target, progress, means, last, end=end)
        return target


def _committed_target(progress: Progress, means: Means) -> Instance | None:
    """The instance that an interrupted run of this very recovery already opened the gate for."""
    state = means.gate.state
    if (
        state.recovery is None
        or state.recovery.id != progress.id
        or state.closed
        or progress.has_failed(state.active_uid)
    ):
        return None
    target = next((i for i in means.instances.of_workload() if i.uid == state.active_uid and i.usable), None)
    if target is not None:
        progress.target = PodIdentity(name=target.name, uid=target.uid)
    return target


def _claim_of(progress: Progress, means: Means) -> str:
    return f"{means.workload_uid}/{progress.id}"


async def _join(me: Waiter, progress: Progress, means: Means) -> None:
    """Say beside the gate that this workload waits. That closes it: an instance that failed doesn't drive meanwhile."""
    progress.moments["queued"] = me.since
    progress.waiting = me
    means.save(progress)
    state = means.gate.state
    if not state.closed or state.recovery is None or state.recovery.waiting != me:
        await means.gate.commit(None, progress)
    progress.moments.setdefault("fenced", means.clock())


async def _both(*work: Coroutine[Any, Any, object]) -> None:
    """Do things at the same time, and wait for each of them also where another fails: a commit mustn't be left under way."""
    for result in await asyncio.gather(*work, return_exceptions=True):
        if isinstance(result, BaseException):
            raise result


async def _close(progress: Progress, means: Means) -> None:
    if not means.gate.state.closed:
        await means.gate.commit(None, progress)
    progress.moments.setdefault("fenced", means.clock())


async def open_for(target: Instance, progress: Progress, means: Means) -> None:
    """Name an instance in the gate, and no other: one write fences the one and routes the other."""
    progress.target = PodIdentity(name=target.name, uid=target.uid)
    progress.moments["committing"] = means.clock()
    await means.agents.probe(target, PROBE_SECONDS)
    committing = asyncio.create_task(means.gate.commit(target, progress))
    try:
        # The rest waits until the commit, which carries the progress, has left for the API server: its request is begun in
        # one round of the event loop and written in the next.
        for _ in range(2):
            await asyncio.sleep(0)
        for instance in means.instances.of_workload():
            if any(pod.uid == instance.uid for pod in progress.replaced):
                await means.agents.probe(instance, PROBE_SECONDS)
        means.save(progress)
        await committing
    finally:
        committing.cancel()
    progress.moments["committed"] = means.clock()


async def _started(target: Instance, progress: Progress, means: Means) -> None:
    """Wait until a new instance's processes are up: the end of the paper's t_startup."""
    if target.has_agent:
        up = await means.agents.up(target)
        progress.moments["started"] = up
        progress.charge("startup", up)


async def _make_ready(
    target: Instance, progress: Progress, means: Means, recovery: BringUp | None, *, within: float
) -> None:
    """Bring an instance whose processes are up to where it can drive while another one does, with the state that is kept of that.

    Raises NotVerified.
    """
    end = _now() + within
    progress.target = PodIdentity(name=target.name, uid=target.uid)
    await _prepare(target, progress, means, recovery, end=end)
    if target.has_agent:
        progress.moments["ready"] = await means.agents.ready(target)
        return
    await means.instances.wait(lambda i: i.uid == target.uid and i.ready)
    progress.moments["ready"] = means.clock()


async def _bring_up(
    target: Instance, progress: Progress, means: Means, recovery: BringUp | None, *, end: float
) -> None:
    """Bring an instance whose processes are up to where it can drive, and open the gate for it.

    State, procedure and the wait for its outputs are the paper's t_re-initialization. ``end`` of the strategy's time is by
    the event loop's clock.
    """
    await _prepare(target, progress, means, recovery, end=end)
    if target.has_agent:
        try:
            # An application may need an answer of the robot before its outputs flow: half the time for the other order.
            async with asyncio.timeout(max(MOMENT, (end - _now()) / 2)):
                ready = await means.agents.ready(target)
            progress.moments["ready"] = ready
        except TimeoutError:
            ready = means.clock()
        progress.charge("reinitialization", ready)
    await open_for(target, progress, means)
    await wait_enforced(target, progress, means)


async def _prepare(target: Instance, progress: Progress, means: Means, recovery: BringUp | None, *, end: float) -> None:
    """Give an instance whose processes are up the state, and run the procedure that brings it to where it can drive."""
    if recovery is None or not recovery.restores_state or not target.has_agent:
        await restore(target, progress, means)
    if recovery is not None and target.has_agent:
        rest = end - _now()
        within = min(recovery.within, max(MOMENT, rest - min(ANSWER, rest / 4)))
        state = kept(progress, means) if recovery.restores_state else KeptState()
        report = await means.agents.bring_up(target, recovery, within=within, state=state)
        progress.charge("reinitialization", means.clock())  # the outputs of one that ran before were ready long ago
        if recovery.restores_state:
            progress.note_state(report)
            means.save(progress)


def _told(moments: dict[str, float], *steps: str) -> str:
    """When steps were done, after the decision."""
    decided = moments.get("decided", 0.0)
    return ", ".join(f"{step} {(moments[step] - decided) * 1000:+.1f} ms" for step in steps if step in moments)


def _now() -> float:
    return asyncio.get_running_loop().time()


async def restore(target: Instance, progress: Progress, means: Means) -> None:
    """Give a started instance the state of the last healthy one, as far as that can be.

    What can't be given is recorded and keeps nothing back: a robot that nobody drives is worse off than one whose
    application begins without some of its state. Where that isn't so, a recovery tree can insist (restore_state).
    """
    state = kept(progress, means)
    if not state and not state.left_out:
        return
    if target.has_agent:
        report = await means.agents.restore(target, state, means.restore_within)
    else:
        report = state.not_given(f"pod {target.name} has no agent, since a referred controller made it")
    progress.note_state(report)
    means.save(progress)


def kept(progress: Progress, means: Means) -> KeptState:
    """The state to give after this failure; the same however often it is asked for."""
    return means.kept(progress.moments.get("last_healthy", progress.cursor))


async def wait_enforced(target: Instance, progress: Progress, means: Means) -> None:
    """Note when the gate was enforced: seen from probes, or, without an agent, taken from the commit."""
    since = progress.moments.get("committing", progress.cursor)
    routed = progress.moments.get("committed", means.clock())
    if target.has_agent:
        try:
            async with asyncio.timeout(ENFORCED_WITHIN):
                routed = await means.gate.enforced(target, since=since)
        except TimeoutError:
            routed = means.clock()
    progress.moments["routed"] = routed
    progress.charge("cluster", routed)
    _logger.info("gate for %s: %s", target.name, _told(progress.moments, "committing", "committed", "routed"))
    # In one commit the failed pod is fenced where the understudy is routed; its last packet says if it was later.
    fenced = progress.moments.setdefault("fenced", routed)
    for pod in progress.replaced:
        last = means.gate.last_packet(pod.uid)
        if last is not None and last > fenced:
            progress.moments["fenced"] = last
