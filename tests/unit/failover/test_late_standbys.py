"""A standby that becomes ready while a recovery without it waits for a new pod."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest

from tests.unit.failover.recoveries import VERIFY_WITHIN, choices, failure, protected
from tests.unit.failover.world import Killed, Store, World
from understudy.api.kinds.robot_workload import Attempt
from understudy.failover.interfaces import Instance
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import StrategyContext
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback


def starting() -> Store:
    """A workload whose standby is not ready yet."""
    store = protected(pool="hot")
    store.pods["w-2"] = Instance(name="w-2", uid="uid-w-2", pool="hot", running=True, ready=False)
    return store


def become_ready(store: Store) -> None:
    store.add("w-2", pool="hot")


def without_new_pods(context: StrategyContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if Kubernetes' own controllers did nothing: deletions are carried out, and no new pod follows."""

    async def replace(failed: Sequence[Instance]) -> None:
        for instance in failed:
            await context.instances.retire(instance)

    monkeypatch.setattr(context.instances, "replace", replace)


async def test_a_standby_that_becomes_ready_takes_over_while_no_new_pod_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    store = starting()
    world = World(store)
    context = world.context()
    without_new_pods(context, monkeypatch)
    asyncio.get_running_loop().call_later(VERIFY_WITHIN / 2, become_ready, store)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), context)
    assert [(a.strategy, a.pod, a.result) for a in done.attempts] == [
        ("Fallback/Executing", "", "NotAvailable"),
        ("Restart", "", "NotVerified"),
        ("Fallback/Executing", "w-2", "Verified"),
    ]
    assert store.commits == ["", "w-2"]
    assert not done.has_failed("uid-w-2")
    assert "w-2" in store.followed, "its agent may know sooner than Kubernetes that it is ready"


async def test_the_monitor_that_continues_a_restart_takes_a_standby_that_became_ready_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    store = starting()
    world = World(store, dies_after=3)
    with pytest.raises(Killed):
        await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    become_ready(store)
    successor = World(store)
    context = successor.context()
    without_new_pods(context, monkeypatch)
    begun = store.journal
    assert begun is not None
    assert begun.strategy == "Restart"
    done = await recover(begun, choices(ExecutingFallback("hot"), Restart()), context)
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")


async def test_a_new_pod_that_exists_is_brought_up_although_a_standby_becomes_ready() -> None:
    store = starting()
    world = World(store)
    store.broken.add("w-new1")
    loop = asyncio.get_running_loop()
    loop.call_later(0.02, become_ready, store)
    loop.call_later(VERIFY_WITHIN / 2, store.broken.discard, "w-new1")
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")


async def test_a_standby_that_comes_and_goes_delays_the_restart_once() -> None:
    store = starting()
    world = World(store)
    context = world.context()
    progress = failure(world)
    progress.attempts += [
        Attempt(strategy="Fallback/Executing", result="NotAvailable"),
        Attempt(strategy="Fallback/Executing", result="NotAvailable"),
    ]
    progress.index = 1
    become_ready(store)
    done = await recover(progress, choices(ExecutingFallback("hot"), Restart()), context)
    assert (done.result, done.strategy) == ("Recovered", "Restart")


async def test_a_restart_that_fails_is_followed_by_a_standby_that_is_ready_by_then() -> None:
    store = starting()
    world = World(store)
    context = world.context()
    store.source_makes_broken = True
    asyncio.get_running_loop().call_later(VERIFY_WITHIN / 2, become_ready, store)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), context)
    assert [(a.strategy, a.result) for a in done.attempts] == [
        ("Fallback/Executing", "NotAvailable"),
        ("Restart", "NotVerified"),
        ("Fallback/Executing", "Verified"),
    ]


async def test_a_strategy_that_failed_is_not_carried_out_again_after_a_late_standby_that_fails_too() -> None:
    store = starting()
    for name in ("s-1", "s-2"):
        store.pods[name] = Instance(name, f"uid-{name}", pool="shared", running=True, ready=True, held=True)
    store.broken |= {"s-1", "s-2", "w-2"}
    world = World(store)
    asyncio.get_running_loop().call_later(VERIFY_WITHIN / 2, become_ready, store)
    strategies = (ExecutingFallback("hot"), UninitializedFallback("shared"), Restart())
    done = await recover(failure(world), choices(*strategies), world.context())
    assert [attempt.strategy for attempt in done.attempts] == [
        "Fallback/Executing", "Fallback/Uninitialized", "Fallback/Executing", "Restart"
    ]  # fmt: skip
    assert len(store.claims) == 1
