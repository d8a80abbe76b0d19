"""The order in which several workloads get pods of a shared pool that is empty.

No central component assigns the pods. Each waiting monitor records next to its gate that it waits, reads which other monitors wait, and
leaves a free pod to those ahead of it. It does so only for a moment, because one of them may have died. The first claim that is written
decides who owns a pod in any case.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterable, Sequence
from typing import Protocol, TypeVar

from pydantic import Field

from understudy.api.base import Model
from understudy.api.moments import UnixTime

YIELD = 0.5
"""Seconds for which a free pod is left to each waiter ahead. A waiter takes a pod within milliseconds of seeing it; the rest allows for a
late watch on a busy machine.
"""

YIELD_MOST = 1.5
"""Maximum seconds for which a free pod is left to others, however many they are. After that, any waiter may take it."""

CHECK_PERIOD = 0.25
"""Seconds after which a waiter checks again without an event, because the times of other waiters also expire."""

Pod = TypeVar("Pod")


class Waiter(Model):
    """A workload that waits for a pod of a shared pool. Times are of its monitor's process; in a record, of its node's clock."""

    workload: str
    pool: str
    priority: int = Field(default=0, ge=-1000, le=1000)
    """The workload's ``spec.poolPriority``."""
    since: UnixTime
    until: UnixTime
    """When it gives up. Others ignore its record from then on."""

    @property
    def rank(self) -> tuple[int, float, str]:
        """Sort key; the lowest is served first: by priority, then by who has waited longest."""
        return -self.priority, self.since, self.workload

    def moved(self, seconds: float) -> Waiter:
        """Return the same with both times moved."""
        return (
            self.model_copy(update={"since": self.since + seconds, "until": self.until + seconds}) if seconds else self
        )


class Queue(Protocol):
    """The waiting workloads of the namespace, as this workload's monitor sees them, and its own place among them."""

    @property
    def workload(self) -> str:
        """The name of this workload."""

    @property
    def priority(self) -> int:
        """The ``spec.poolPriority`` of this workload."""

    def others(self, pool: str) -> Sequence[Waiter]:
        """Return the other workloads that wait for a pod of a pool."""

    def waits(self, me: Waiter, ahead: int, of: int) -> None:
        """Report that this workload waits, with the number of waiters ahead of it and in total."""

    def served(self, me: Waiter, pod: str) -> None:
        """Report that this workload got a pod."""

    def gave_up(self, me: Waiter) -> None:
        """Report that this workload stopped waiting without a pod."""

    async def changed(self, pool: str) -> None:
        """Wait until the unclaimed pods of a followed pool, or the waiting workloads, may have changed."""


def in_order(waiters: Iterable[Waiter], pool: str, now: float) -> list[Waiter]:
    """Return the workloads that wait for a pod of a pool at a time, in the order in which they are served."""
    return sorted((w for w in waiters if w.pool == pool and now < w.until), key=lambda w: w.rank)


def before(me: Waiter, others: Iterable[Waiter], now: float) -> int:
    """Return how many waiters are served before this one."""
    return sum(other.rank < me.rank for other in in_order(others, me.pool, now))


def due(ahead: int, free_since: Collection[float]) -> float | None:
    """Return when a waiter may take one of the free pods; None if there are none.

    ``free_since`` has the time at which this waiter first saw each pod free. If there are more pods than waiters ahead of it, it may take
    one at once. Otherwise it waits YIELD seconds for each missing pod, but no more than YIELD_MOST.
    """
    if not free_since:
        return None
    lacking = max(0, ahead + 1 - len(free_since))
    return min(free_since) + min(lacking * YIELD, YIELD_MOST)


def at_once(me: Waiter, others: Iterable[Waiter], free: int, now: float) -> bool:
    """Return whether a waiter may take a pod at once if so many are free."""
    return due(before(me, others, now), [now] * free) == now


def left_by(ahead: int, pods: Sequence[Pod]) -> Sequence[Pod]:
    """Return the pods that a waiter may take when it is due, in order. Each waiter ahead is left one of the first pods.

    If there are not enough pods for all, the waiters ahead have had their time.
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
    """Wait until this workload may take a free pod; return False if its time ended first or waiting was ``needless``.

    ``free`` returns the UIDs of the pods that can be claimed now. ``join`` records for others that this workload waits. It is called once,
    and only if the workload waits at all; without it, the workload only leaves a free pod to those ahead of it for the same time.
    """
    waiting_pods: dict[str, float] = {}
    joined = False
    while True:
        now = clock()
        others = in_order(queue.others(me.pool), me.pool, now)
        ahead = before(me, others, now)
        waiting_pods = {uid: waiting_pods.get(uid, now) for uid in free()}
        at = due(ahead, waiting_pods.values())
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
