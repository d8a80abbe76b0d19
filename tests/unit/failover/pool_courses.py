"""Robots that wait for one pool, for tests."""

from __future__ import annotations

import asyncio

from tests.unit.failover.recoveries import failure
from tests.unit.failover.world import Store, World
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback

POOL = "spare"


def place(workload: str, priority: int = 0, since: float = 0.0, until: float = 100.0) -> Waiter:
    return Waiter(workload=workload, pool=POOL, priority=priority, since=since, until=until)


async def fails(store: Store, wait_for: float, *, verify_within: float = 0.3) -> Progress:
    world = World(store)
    ladder = [
        Choice(UninitializedFallback(POOL, wait_for=wait_for), verify_within),
        Choice(Restart(), verify_within),
    ]
    return await recover(failure(world, f"{store.workload}-1"), ladder, world.context())


async def until(predicate: object) -> None:
    async with asyncio.timeout(5):
        while not predicate():  # type: ignore[operator]
            await asyncio.sleep(0.005)
