"""Recoveries and their strategies, for tests of the protocol."""

from __future__ import annotations

from tests.unit.failover.world import Store, World
from understudy.failover.interfaces import GateState
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Choice

VERIFY_WITHIN = 0.3


def choices(*strategies: object) -> list[Choice]:
    return [Choice(strategy, VERIFY_WITHIN) for strategy in strategies]  # type: ignore[arg-type]


def failure(world: World, pod: str = "w-1") -> Progress:
    now = world.clock()
    failed = [PodIdentity(name=pod, uid=f"uid-{pod}")] if pod else []
    return Progress.begin("no /cmd_vel for 500 ms", last_healthy=now - 0.5, detected=now, failed=failed)


def protected(**standby: object) -> Store:
    store = Store()
    store.add("w-1")
    store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
    store.broken.add("w-1")
    if standby:
        store.add("w-2", **standby)
    return store
