"""Whose turn it is at a shared pool that has run dry: by priority, then by who has waited longest, and never blocked by the dead."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.failover.recoveries import choices, failure
from tests.unit.failover.world import Killed, Store, World
from understudy.failover import pool_queue
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pool_queue import YIELD, YIELD_MOST, Waiter, before, due, in_order, left_by
from understudy.failover.progress import Progress, waiter
from understudy.failover.protocol import Choice, recover
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback, apart

POOL = "spare"


# -- the rule itself, over all times --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Robot:
    """One that fails at a time, waits for so long, and whose monitor may have died as soon as it had said so."""

    priority: int
    fails: float
    patience: float
    dead: bool = False


@dataclass
class Course:
    """The result of a run: which workload was served when, and how."""

    served: dict[int, tuple[float, int]] = field(default_factory=dict)
    """Time and pod by robot."""
    tried: list[tuple[float, int, int]] = field(default_factory=list)
    """Every attempt to claim: time, robot and pod."""
    overtaken: list[float] = field(default_factory=list)
    """For each that was alive, waited and ranked before the one that was served: how long that one had left the pod to others."""
    idle: list[tuple[float, float]] = field(default_factory=list)
    """Spans in which a pod was free and the same living robot waited."""


def play(robots: Sequence[Robot], pods: Sequence[float]) -> Course:
    """Let robots wait for pods that become free at times. Everybody sees everything at once; the dead do nothing."""
    course, free = Course(), dict[int, float]()
    places = [
        Waiter(workload=f"w{i}", pool=POOL, priority=r.priority, since=r.fails, until=r.fails + r.patience)
        for i, r in enumerate(robots)
    ]
    coming = sorted(pods)
    now = 0.0
    while True:
        while coming and coming[0] <= now:
            since = coming.pop(0)
            free[len(pods) - len(coming)] = since
        at_it = {i for i, p in enumerate(places) if p.since <= now < p.until and i not in course.served}
        living = sorted((i for i in at_it if not robots[i].dead), key=lambda i: places[i].rank)
        looks: dict[int, float] = {}
        for i in living:
            if i in course.served:
                continue
            others = [places[j] for j in at_it if j != i and j not in course.served]
            ahead = before(places[i], others, now)
            seen = {pod: max(since, places[i].since) for pod, since in free.items()}
            at = due(ahead, seen.values())
            if at is None:
                continue
            if at > now:
                looks[i] = at
                continue
            pod = left_by(ahead, list(free))[0]
            course.tried.append((now, i, pod))
            course.served[i] = (now, pod)
            passed = [j for j in living if j not in course.served and places[j].rank < places[i].rank]
            course.overtaken += [now - min(seen.values()) for _ in passed]
            del free[pod]
        left = [i for i in living if i not in course.served]
        course.idle += [(max(since, places[i].since), now) for since in free.values() for i in left]
        moments = [p.since for i, p in enumerate(places) if i not in course.served]
        moments += [p.until for p in places] + coming + list(looks.values())
        later = [moment for moment in moments if moment > now]
        if not later:
            return course
        now = min(later)


TIMES = st.integers(0, 400).map(lambda tenths: tenths / 10)
ROBOTS = st.builds(
    Robot, st.sampled_from([-1, 0, 0, 5, 100]), TIMES, st.integers(1, 200).map(lambda tenths: tenths / 10)
)
MORTALS = st.builds(
    Robot, st.sampled_from([-1, 0, 5]), TIMES, st.integers(1, 200).map(lambda tenths: tenths / 10), st.booleans()
)
PODS = st.lists(TIMES, max_size=8)


@given(st.lists(ROBOTS, max_size=7), PODS)
def test_among_the_living_nobody_is_served_before_one_that_ranks_before_it(
    robots: list[Robot], pods: list[float]
) -> None:
    assert play(robots, pods).overtaken == []


@given(st.lists(MORTALS, max_size=7), PODS)
def test_a_pod_drives_one_robot_and_nobody_waits_for_a_vanished_one_for_long(
    robots: list[Robot], pods: list[float]
) -> None:
    course = play(robots, pods)
    taken = [pod for _, pod in course.served.values()]
    assert len(taken) == len(set(taken))
    assert len(course.tried) == len(taken), "nobody goes for a pod that another takes"
    assert all(end - begin <= YIELD_MOST + 1e-9 for begin, end in course.idle)


@given(st.lists(MORTALS, max_size=7), PODS)
def test_a_living_one_is_overtaken_only_at_a_pod_that_was_left_for_as_long_as_it_can_be(
    robots: list[Robot], pods: list[float]
) -> None:
    assert all(left >= YIELD_MOST - 1e-9 for left in play(robots, pods).overtaken)


def place(workload: str, priority: int = 0, since: float = 0.0, until: float = 100.0) -> Waiter:
    return Waiter(workload=workload, pool=POOL, priority=priority, since=since, until=until)


def test_workloads_are_ordered_by_priority_then_waiting_time_then_name() -> None:
    waiters = [place("b", since=2), place("a", since=2), place("c", since=1), place("d", priority=1, since=3)]
    assert [w.workload for w in in_order(waiters, POOL, now=4)] == ["d", "c", "a", "b"]


def test_whose_time_is_over_or_who_waits_for_another_pool_is_before_nobody() -> None:
    late = place("late", priority=9, until=5)
    elsewhere = place("elsewhere", priority=9).model_copy(update={"pool": "other"})
    assert before(place("me"), [late, elsewhere], now=5) == 0


@pytest.mark.parametrize(
    ("ahead", "free", "at"),
    [
        (0, [], None),
        (0, [3.0], 3.0),
        (1, [3.0], 3.0 + YIELD),
        (1, [3.0, 3.2], 3.0),
        (2, [3.0, 3.2], 3.0 + YIELD),
        (50, [3.0], 3.0 + YIELD_MOST),
    ],
)
def test_a_free_pod_is_left_to_each_that_is_before_for_a_moment(
    ahead: int, free: list[float], at: float | None
) -> None:
    assert due(ahead, free) == at


def test_two_waiting_workloads_claim_different_pods() -> None:
    assert [left_by(ahead, ["p1", "p2"])[0] for ahead in (0, 1)] == ["p1", "p2"]
    assert left_by(2, ["p1", "p2"]) == ["p1", "p2"], "left long enough by those ahead, whichever it is"


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


async def fails(store: Store, wait_for: float, *, verify_within: float = 0.3) -> Progress:
    world = World(store)
    ladder = [
        Choice(UninitializedFallback(POOL, wait_for=wait_for), verify_within),
        Choice(Restart(), verify_within),
    ]
    return await recover(failure(world, f"{store.workload}-1"), ladder, world.means())


async def until(predicate: object) -> None:
    async with asyncio.timeout(5):
        while not predicate():  # type: ignore[operator]
            await asyncio.sleep(0.005)


async def test_a_dry_pool_is_waited_for_behind_a_closed_gate_and_the_wait_does_not_count_as_verifying() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    running = asyncio.create_task(fails(store, wait_for=5.0))
    await until(lambda: store.told)
    assert store.told == ["1 of 1"]
    assert store.gate.closed, "an instance that failed doesn't drive while its workload waits"
    await asyncio.sleep(0.4)  # longer than it has to verify
    refill(fleet, "p1")
    done = await running
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Uninitialized")
    assert store.told == ["1 of 1", "served with p1"]
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
    assert done.attempts[0].message == "no pod of FallbackPool spare is ready; it got none in 0.2 s"
    assert store.told == ["1 of 1", "gave up"]
    assert done.waiting is None
    assert waiter(store.gate.recovery.model_dump_json()) is None  # type: ignore[union-attr]


async def test_a_pod_that_the_workload_s_own_controller_has_up_first_is_taken_and_no_other_waited_for() -> None:
    store = robot("a", [])
    running = asyncio.create_task(fails(store, wait_for=60.0))
    await until(lambda: store.told)
    store.add("a-2", ready=False)
    await asyncio.sleep(0.4)
    assert not running.done(), "it doesn't drive yet"
    assert "a-2" in store.followed, "and its agent is asked how it is"
    store.add("a-2")
    done = await asyncio.wait_for(running, 5)
    assert done.strategy == "Restart"
    assert done.target is not None
    assert done.target.name == "a-2"
    assert done.attempts[0].message == "no pod of FallbackPool spare is ready; a-2 is up already"


async def test_each_pool_is_awaited_in_order() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    world = World(store)
    ladder = choices(UninitializedFallback("first", wait_for=0.1), UninitializedFallback(POOL, wait_for=5.0), Restart())
    running = asyncio.create_task(recover(failure(world, "a-1"), ladder, world.means()))
    await until(lambda: len(store.told) == 3)
    assert store.gate.recovery is not None
    assert store.gate.recovery.waiting is not None
    assert store.gate.recovery.waiting.pool == POOL
    refill(fleet, "p1")
    done = await running
    assert (done.index, done.result) == (1, "Recovered")


async def test_a_more_critical_workload_is_served_first_although_it_came_later() -> None:
    fleet: list[Store] = []
    low, high = robot("low", fleet), robot("high", fleet, priority=100)
    tasks = [asyncio.create_task(fails(low, 10.0))]
    await until(lambda: low.told)
    tasks.append(asyncio.create_task(fails(high, 10.0)))
    await until(lambda: low.told[-1:] == ["2 of 2"])
    refill(fleet, "p1")
    await until(lambda: "p1" in high.claims)
    refill(fleet, "p2")
    done = await asyncio.gather(*tasks)
    assert [d.result for d in done] == ["Recovered", "Recovered"]
    assert (list(low.claims), list(high.claims)) == (["p2"], ["p1"])


async def test_two_pods_at_once_serve_two_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_queue, "YIELD", 60.0)
    monkeypatch.setattr(pool_queue, "YIELD_MOST", 60.0)
    fleet: list[Store] = []
    stores = [robot("low", fleet), robot("high", fleet, priority=100)]
    tasks = [asyncio.create_task(fails(store, 10.0)) for store in stores]
    await until(lambda: all(store.told for store in stores))
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
    await until(lambda: low.told == ["2 of 2"])
    refill(fleet, "p1")
    begun = asyncio.get_running_loop().time()
    done = await running
    assert 0.09 < done.moments["claimed"] - begun < 3, "after its moment, and not after its time"
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
    assert low.told == [], "it never waited"


async def test_a_planned_switchover_takes_no_pod_that_others_wait_for() -> None:
    fleet: list[Store] = []
    other, degraded = robot("other", fleet), robot("degraded", fleet, priority=100)
    note = Progress.begin("it ended", last_healthy=0, detected=0)
    note.waiting = place("other", until=World(other).clock() + 60)
    other.gate = GateState(epoch=2, recovery=note)
    refill(fleet, "p1")
    world = World(degraded)
    strategy = UninitializedFallback(POOL, wait_for=10.0)
    await strategy.look(world.means())
    assert strategy.availability(world.means()).reason == "PodsAwaited"
    assert "other" in strategy.availability(world.means()).message
    planned = failure(world, "degraded-1").model_copy(update={"planned": True})
    done = await recover(planned, choices(strategy), world.means())
    assert (done.result, done.attempts[0].result) == ("Failed", "NotAvailable")
    refill(fleet, "p2")
    await strategy.look(world.means())
    assert strategy.available(world.means()) is None


@pytest.mark.parametrize(("pods", "taken"), [(1, []), (2, ["p1"])])
async def test_the_reserved_pods_of_a_pool_are_kept_for_critical_workloads(pods: int, taken: list[str]) -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(pods):
        refill(fleet, f"p{number + 1}")
    world = World(store)
    strategy = UninitializedFallback(POOL, reserved=1)
    await strategy.look(world.means())
    assert strategy.availability(world.means()).reason == ("" if taken else "PodsReserved")
    done = await recover(failure(world, "a-1"), choices(strategy, Restart()), world.means())
    assert list(store.claims) == taken
    assert done.strategy == ("Fallback/Uninitialized" if taken else "Restart")


async def test_one_that_waits_leaves_the_reserve_to_the_critical_and_takes_what_comes_beyond_it() -> None:
    fleet: list[Store] = []
    store, critical = robot("a", fleet), robot("b", fleet, priority=100)
    refill(fleet, "p1")
    world = World(store)
    ladder = choices(UninitializedFallback(POOL, wait_for=5.0, reserved=1))
    running = asyncio.create_task(recover(failure(world, "a-1"), ladder, world.means()))
    await until(lambda: store.told)
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
    await until(lambda: store.told)
    refill(fleet, "p2")
    done = await running
    assert list(store.claims) == ["p2"]
    assert done.strategy == "Fallback/Uninitialized"


async def test_a_monitor_killed_at_any_step_of_a_wait_is_finished_by_the_next() -> None:
    async def run(store: Store, world: World, progress: Progress) -> Progress:
        there = "p1" in store.pods or store.claims
        coming = asyncio.get_running_loop().call_later(0.03, lambda: there or refill(store.fleet, "p1"))
        try:
            ladder = choices(UninitializedFallback(POOL, wait_for=10.0), Restart())
            return await recover(progress, ladder, world.means())
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


async def test_who_fails_with_a_full_pool_asks_for_its_part_and_watches_nothing() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(4):
        refill(fleet, f"p{number}")
    store.other_parts = {"p0", "p1", "p3"}
    done = await recover(
        failure(World(store), "a-1"), choices(UninitializedFallback(POOL, wait_for=5.0)), World(store).means()
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


async def test_where_the_pool_keeps_some_for_others_all_are_asked_for_since_they_count() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    for number in range(2):
        refill(fleet, f"p{number}")
    world = World(store)
    await recover(failure(world, "a-1"), choices(UninitializedFallback(POOL, reserved=1)), world.means())
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


async def test_while_nothing_has_failed_it_goes_by_what_the_operator_says_of_the_pool() -> None:
    fleet: list[Store] = []
    store = robot("a", fleet)
    strategy = UninitializedFallback(POOL)
    assert strategy.outlook(World(store).means()) == f"pool {POOL} has no pod that it could claim"
    store.stocked = {POOL}
    assert strategy.outlook(World(store).means()) is None
    assert store.looks == []
