"""The order in which several workloads get pods of a shared pool that is empty.

Nobody hands the pods out. Each waiting monitor records that it waits next to its gate, looks who else waits, and leaves a free pod
to those before it. For a moment only, since one of them may have died; and whoever writes first owns the pod anyway (the claim).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterable, Sequence
from typing import Protocol, TypeVar

from understudy.api.base import Model

YIELD = 0.5
"""Seconds for which a free pod is left to each waiter before this one. It takes its pod within milliseconds of seeing it; of
the rest a watch that is late on a busy machine takes its share."""

YIELD_MOST = 1.5
"""Most seconds for which a free pod is left to others, however many they are: after that, whoever is first has it."""

CHECK_PERIOD = 0.25
"""Seconds after which a waiter looks again though nothing seems to have changed: times of others pass too."""

Pod = TypeVar("Pod")


class Waiter(Model):
    """One workload that waits for a pod of a shared pool. Times are unix seconds, by the clock of its monitor's node."""

    workload: str
    pool: str
    priority: int = 0
    since: float
    until: float
    """When it gives up. Whatever it may still say then, nobody minds it any more."""

    @property
    def rank(self) -> tuple[int, float, str]:
        """Who is served first has the lowest: the most critical, of those who has waited longest."""
        return -self.priority, self.since, self.workload


class Queue(Protocol):
    """The workloads of the namespace that wait, as this one's monitor sees them, and its own place among them."""

    @property
    def workload(self) -> str:
        """Its own workload."""

    @property
    def priority(self) -> int:
        """Its own ``spec.poolPriority``."""

    def others(self, pool: str) -> Sequence[Waiter]:
        """The other workloads that say that they wait for a pod of a pool."""

    def waits(self, me: Waiter, ahead: int, of: int) -> None:
        """Tell people that this one waits, so many being before it and so many in all."""

    def served(self, me: Waiter, pod: str) -> None:
        """Tell people that it got a pod."""

    def gave_up(self, me: Waiter) -> None:
        """Tell people that its time was over."""

    async def changed(self, pool: str) -> None:
        """Return when the unclaimed pods of a pool, while they are followed, or who waits, may be others than before."""


def in_order(waiters: Iterable[Waiter], pool: str, now: float) -> list[Waiter]:
    """Those that wait for a pod of a pool at a time, who is served first before the others."""
    return sorted((w for w in waiters if w.pool == pool and now < w.until), key=lambda w: w.rank)


def before(me: Waiter, others: Iterable[Waiter], now: float) -> int:
    """How many are served before this one."""
    return sum(other.rank < me.rank for other in in_order(others, me.pool, now))


def due(ahead: int, free_since: Collection[float]) -> float | None:
    """Return when a waiter may take one of the pods, given since when it has seen each of them free; None if there are none.

    Where there are more pods than waiters ahead of it, at once. Else those ahead have a moment each.
    """
    if not free_since:
        return None
    lacking = max(0, ahead + 1 - len(free_since))
    return min(free_since) + min(lacking * YIELD, YIELD_MOST)


def at_once(me: Waiter, others: Iterable[Waiter], free: int, now: float) -> bool:
    """Whether one needn't wait where there are so many free pods."""
    return due(before(me, others, now), [now] * free) == now


def left_by(ahead: int, pods: Sequence[Pod]) -> Sequence[Pod]:
    """The pods that a waiter whose turn it is may take, in order: those ahead take as many of the first ones.

    Where there aren't enough for all, those ahead had their moment.
    """
    return pods[ahead:] if ahead < len(pods) else pods


async def turn(
    me: Waiter,
    queue: Queue,
    *,
    free: Callable[[], Collection[str]],
    clock: Callable[[], float],
    join: Callable[[], Awaitable[None]],
    needless: Callable[[], bool] = lambda: False,
) -> bool:
    """Wait until this one may take a free pod; whether that was so before its time was over, or waiting was ``needless``.

    ``free`` has the UIDs of the pods that can be claimed now. ``join`` says to the others that it waits: called once, and only
    where it waits at all; who doesn't, leaves a pod that is free to those ahead of it for the same moment.
    """
    seen: dict[str, float] = {}
    joined = False
    while True:
        now = clock()
        others = in_order(queue.others(me.pool), me.pool, now)
        ahead = before(me, others, now)
        seen = {uid: seen.get(uid, now) for uid in free()}
        at = due(ahead, seen.values())
        if at is not None and at <= now:
            return True
        if now >= (me.until if at is None else me.until + YIELD_MOST) or (me.until > me.since and needless()):
            return False
        if not joined and now < me.until:
            joined = True
            queue.waits(me, ahead, len(others) + 1)
            await join()
            continue
        if joined:
            queue.waits(me, ahead, len(others) + 1)
        try:
            async with asyncio.timeout(max(0.0, min(now + CHECK_PERIOD, me.until if at is None else at) - now)):
                await queue.changed(me.pool)
        except TimeoutError:
            continue
