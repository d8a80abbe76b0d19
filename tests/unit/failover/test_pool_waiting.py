"""Whose turn it is at a shared pool that has run dry: by priority, then by who has waited longest, and never blocked by the dead."""

from __future__ import annotations

import asyncio

import pytest

from tests.support.golden import assert_golden
from tests.unit.failover.pool_courses import POOL, fails, place, until
from tests.unit.failover.recoveries import choices, failure
from tests.unit.failover.world import Killed, Store, World
from understudy.failover import pool_queue
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import Progress, waiter
from understudy.failover.protocol import recover
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback, apart

# -- within the failover protocol -----------------------------------------------------------------------------------------


def robot(name: str, fleet: list[Store], priority: int = 0) -> Store:
    """A workload whose instance has failed, in a namespace with others."""
    store = Store(workload=name, priority=priority, fleet=fleet)
    store.add(f"{name}-1")
    store.gate = GateState(epoch=1, active=f"{name}-1", active_uid=f"uid-{name}-1")
    store.broken.add(f"{name}-1")
    fleet.append(store)
    return store


def refill(fleet: list[Store], name: str) -> None:
    for store in fleet:
        store.add(name, pool=POOL, held=True)


async def test_a_workload_waits_behind_a_closed_gate_and_the_wait_is_not_verification_time() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    running = asyncio.create_task(fails(store, wait_for=5.0))
    await until(lambda: store.messages)
    assert store.messages == ["1 of 1"]
    await until(lambda: store.gate.closed)  # an instance that failed does not drive while its workload waits
    await asyncio.sleep(0.4)  # longer than it has to verify
    refill(fleet, "p1")
    done = await running
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Uninitialized")
    assert store.messages == ["1 of 1", "served with p1"]
    assert store.commits == ["", "", "p1"], "one write more than without waiting"
    assert waiter(store.gate.recovery.model_dump_json()) is None  # type: ignore[union-attr]
    assert done.moments["claimed"] - done.moments["queued"] >= 0.4
    assert done.to_recovery(1).moments.queued is not None
    assert sum(done.parts.values()) == pytest.approx(done.moments["routed"] - done.moments["last_healthy"], abs=1e-6)


async def test_after_its_maximum_wait_a_workload_tries_the_next_strategy() -> None:
    store = robot("a", [])
    done = await fails(store, wait_for=0.2)
    assert [(a.strategy, a.result) for a in done.attempts] == [
        ("Fallback/Uninitialized", "NotAvailable"),
        ("Restart", "Verified"),
    ]
    assert_golden("failover", done.attempts[0].message, "FallbackPool spare", "0.2 s")
    assert store.messages == ["1 of 1", "gave up"]
    assert done.waiting is None
    assert waiter(store.gate.recovery.model_dump_json()) is None  # type: ignore[union-attr]


async def test_a_pod_of_the_workload_controller_that_is_ready_first_ends_the_wait() -> None:
    store = robot("a", [])
    running = asyncio.create_task(fails(store, wait_for=60.0))
    await until(lambda: store.messages)
    store.add("a-2", ready=False)
    await asyncio.sleep(0.4)
    assert not running.done(), "it doesn't drive yet"
    assert "a-2" in store.followed, "and its agent is asked how it is"
    store.add("a-2")
    done = await asyncio.wait_for(running, 5)
    assert done.strategy == "Restart"
    assert done.target is not None
    assert done.target.name == "a-2"
    assert_golden("failover", done.attempts[0].message, "FallbackPool spare", "a-2")


async def test_each_pool_is_awaited_in_order() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    world = World(store)
    ladder = choices(UninitializedFallback("first", wait_for=0.1), UninitializedFallback(POOL, wait_for=5.0), Restart())
    running = asyncio.create_task(recover(failure(world, "a-1"), ladder, world.context()))
    await until(lambda: len(store.messages) == 3)
    assert store.gate.recovery is not None
    assert store.gate.recovery.waiting is not None
    assert store.gate.recovery.waiting.pool == POOL
    refill(fleet, "p1")
    done = await running
    assert (done.index, done.result) == (1, "Recovered")


async def test_a_workload_of_higher_priority_is_served_first_although_it_came_later() -> None:
    fleet: list[Store] = []
    low, high = robot("low", fleet), robot("high", fleet, priority=100)
    tasks = [asyncio.create_task(fails(low, 10.0))]
    await until(lambda: low.messages)
    tasks.append(asyncio.create_task(fails(high, 10.0)))
    await until(lambda: low.messages[-1:] == ["2 of 2"])
    refill(fleet, "p1")
    await until(lambda: "p1" in high.claims)
    refill(fleet, "p2")
    done = await asyncio.gather(*tasks)
    assert [d.result for d in done] == ["Recovered", "Recovered"]
    assert (list(low.claims), list(high.claims)) == (["p2"], ["p1"])


async def test_two_simultaneous_pods_serve_two_workloads_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_queue, "YIELD", 60.0)
    monkeypatch.setattr(pool_queue, "YIELD_MOST", 60.0)
    fleet: list[Store] = []
    stores = [robot("low", fleet), robot("high", fleet, priority=100)]
    tasks = [asyncio.create_task(fails(store, 10.0)) for store in stores]
    await until(lambda: all(store.messages for store in stores))
    await asyncio.sleep(0.05)
    refill(fleet, "p1")
    refill(fleet, "p2")
    await until(lambda: all(store.claims for store in stores))
    assert [list(store.claims) for store in stores] == [["p2"], ["p1"]]
    await asyncio.gather(*tasks)


async def test_a_waiting_workload_without_a_monitor_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_queue, "YIELD", 0.1)
    fleet: list[Store] = []
    dead, low = robot("dead", fleet, priority=100), robot("low", fleet)
    note = Progress.begin("it ended", last_healthy=0, detected=0)
    note.waiting = place("dead", priority=100, until=World(dead).clock() + 60)
    dead.gate = GateState(epoch=2, recovery=note)
    running = asyncio.create_task(fails(low, 10.0))
    await until(lambda: low.messages == ["2 of 2"])
    refill(fleet, "p1")
    started_at = asyncio.get_running_loop().time()
    done = await running
    assert 0.09 < done.moments["claimed"] - started_at < 3, "after its moment, and not after its time"
    assert list(low.claims) == ["p1"]


async def test_a_workload_that_does_not_wait_takes_a_pod_only_if_nobody_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pool_queue, "YIELD", 0.3)
    fleet: list[Store] = []
    dead, low = robot("dead", fleet, priority=100), robot("low", fleet)
    note = Progress.begin("it ended", last_healthy=0, detected=0)
    note.waiting = place("dead", priority=100, until=World(dead).clock() + 60)
    dead.gate = GateState(epoch=2, recovery=note)
    refill(fleet, "p1")
    running = asyncio.create_task(fails(low, 0.0))
    await asyncio.sleep(0.05)
    assert not low.claims
    assert low.commits == [], "and its gate stays as it is meanwhile"
    assert (await running).strategy == "Fallback/Uninitialized"
    assert low.messages == [], "it never waited"


async def test_a_planned_switchover_takes_no_pod_that_others_wait_for() -> None:
    fleet: list[Store] = []
    other, degraded = robot("other", fleet), robot("degraded", fleet, priority=100)
    note = Progress.begin("it ended", last_healthy=0, detected=0)
    note.waiting = place("other", until=World(other).clock() + 60)
    other.gate = GateState(epoch=2, recovery=note)
    refill(fleet, "p1")
    world = World(degraded)
    strategy = UninitializedFallback(POOL, wait_for=10.0)
    await strategy.refresh(world.context())
    assert strategy.availability(world.context()).reason == "PodsAwaited"
    assert "other" in strategy.availability(world.context()).message
    planned = failure(world, "degraded-1").model_copy(update={"planned": True})
    done = await recover(planned, choices(strategy), world.context())
    assert (done.result, done.attempts[0].result) == ("Failed", "NotAvailable")
    refill(fleet, "p2")
    await strategy.refresh(world.context())
    assert strategy.available(world.context()) is None


@pytest.mark.parametrize(("pods", "taken"), [(1, []), (2, ["p1"])])
async def test_the_reserved_pods_of_a_pool_are_kept_for_critical_workloads(pods: int, taken: list[str]) -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(pods):
        refill(fleet, f"p{number + 1}")
    world = World(store)
    strategy = UninitializedFallback(POOL, reserved=1)
    await strategy.refresh(world.context())
    assert strategy.availability(world.context()).reason == ("" if taken else "PodsReserved")
    done = await recover(failure(world, "a-1"), choices(strategy, Restart()), world.context())
    assert list(store.claims) == taken
    assert done.strategy == ("Fallback/Uninitialized" if taken else "Restart")


async def test_a_waiting_workload_takes_only_pods_beyond_the_reserve() -> None:
    fleet: list[Store] = []
    store, critical = robot("a", fleet), robot("b", fleet, priority=100)
    refill(fleet, "p1")
    world = World(store)
    ladder = choices(UninitializedFallback(POOL, wait_for=5.0, reserved=1))
    running = asyncio.create_task(recover(failure(world, "a-1"), ladder, world.context()))
    await until(lambda: store.messages)
    assert (await fails(critical, 0.0)).result == "Recovered"
    assert list(critical.claims) == ["p1"]
    refill(fleet, "p2")
    await asyncio.sleep(0.1)
    assert not store.claims
    refill(fleet, "p3")
    assert (await running).result == "Recovered"
    assert list(store.claims) == ["p2"]


async def test_a_workload_that_loses_a_claim_returns_to_the_queue() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    store.others_claim.add("p1")
    refill(fleet, "p1")
    running = asyncio.create_task(fails(store, wait_for=5.0))
    await until(lambda: store.messages)
    refill(fleet, "p2")
    done = await running
    assert list(store.claims) == ["p2"]
    assert done.strategy == "Fallback/Uninitialized"


async def test_a_wait_interrupted_at_any_step_is_finished_by_the_next_monitor() -> None:
    async def run(store: Store, world: World, progress: Progress) -> Progress:
        there = "p1" in store.pods or store.claims
        coming = asyncio.get_running_loop().call_later(0.03, lambda: there or refill(store.fleet, "p1"))
        try:
            ladder = choices(UninitializedFallback(POOL, wait_for=10.0), Restart())
            return await recover(progress, ladder, world.context())
        finally:
            coming.cancel()

    whole = World(robot("a", []))
    await run(whole.store, whole, failure(whole, "a-1"))
    for step in range(whole.effects):
        store = robot("a", [])
        first = World(store, dies_after=step)
        progress = failure(first, "a-1")
        with pytest.raises(Killed):
            await run(store, first, progress.model_copy(deep=True))
        kept = store.gate.recovery or store.journal
        second = World(store)
        again = (kept or progress).model_copy(deep=True, update={"resumed": True})
        done = await run(store, second, again)
        assert done.strategy == "Fallback/Uninitialized", f"killed at step {step}: {done.attempts}"
        assert done.target is not None
        assert store.drives(done.target.name), f"killed at step {step}"
        assert len(store.claims) == 1, f"killed at step {step}: claimed more than one pod"
        assert store.gate.recovery is not None
        assert store.gate.recovery.waiting is None, f"killed at step {step}: it still says that it waits"


# -- where nobody waits ---------------------------------------------------------------------------------------------------


def test_robots_that_fail_together_rarely_compete_for_one_pod() -> None:
    """If all began with the same one, a hundred would lose some five thousand races."""
    pods = [Instance(f"spare-{n}", f"pod-{n}") for n in range(100)]
    orders = [apart(pods, f"workload-{n}") for n in range(100)]
    taken, races = set[str](), 0
    while orders:  # everybody tries the next one in their order at the same moment
        left = []
        for order in orders:
            if order[0].uid in taken:
                races += 1
                left.append(order[1:])
            taken.add(order[0].uid)
        orders = left
    assert len(taken) == 100, "everybody gets one"
    assert races < 1500


def test_a_workload_tries_pods_in_an_order_that_does_not_depend_on_the_list() -> None:
    pods = [Instance(f"spare-{n}", f"pod-{n}") for n in range(20)]
    order = apart(pods, "workload")
    assert order == apart(pods[::-1], "workload")
    assert sorted(i.uid for i in order) == sorted(i.uid for i in pods)
    assert [i.uid for i in order if i.uid != order[3].uid] == [
        i.uid for i in apart([i for i in pods if i.uid != order[3].uid], "workload")
    ], "one that is gone changes nothing of the others"


# -- looking for pods ---------------------------------------------------------------------------------------------------


async def test_a_workload_lists_only_its_part_of_a_full_pool_and_watches_nothing() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(4):
        refill(fleet, f"p{number}")
    store.other_parts = {"p0", "p1", "p3"}
    done = await recover(
        failure(World(store), "a-1"), choices(UninitializedFallback(POOL, wait_for=5.0)), World(store).context()
    )
    assert done.result == "Recovered"
    assert (list(store.claims), store.looks) == (["p2"], ["part"])


async def test_a_workload_whose_part_of_the_pool_is_empty_lists_all_pods() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    refill(fleet, "p0")
    store.other_parts = {"p0"}
    done = await fails(store, 5.0)
    assert done.result == "Recovered"
    assert (list(store.claims), store.looks) == (["p0"], ["part", "all"])


async def test_a_workload_lists_all_pods_of_a_pool_with_a_reserve() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(2):
        refill(fleet, f"p{number}")
    world = World(store)
    await recover(failure(world, "a-1"), choices(UninitializedFallback(POOL, reserved=1)), world.context())
    assert store.looks == ["all"]


async def test_a_workload_without_a_pod_watches_the_pool_until_it_has_one() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    running = asyncio.create_task(fails(store, 5.0))
    await asyncio.sleep(0.05)
    assert store.looks == ["part", "all", "followed"]
    refill(fleet, "p0")
    assert (await running).result == "Recovered"
    assert store.looks == ["part", "all", "followed"]


async def test_pool_availability_before_a_failure_comes_from_the_status_of_the_operator() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    strategy = UninitializedFallback(POOL)
    assert strategy.available_as_reported(World(store).context()) == f"pool {POOL} has no pod that it could claim"
    store.stocked = {POOL}
    assert strategy.available_as_reported(World(store).context()) is None
    assert store.looks == []
