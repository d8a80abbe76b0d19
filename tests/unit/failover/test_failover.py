"""The failover protocol: who ends up in control, through escalation and through the death of the monitor at every step."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.support.golden import assert_golden
from tests.unit.failover.recoveries import VERIFY_WITHIN, choices, failure, protected
from tests.unit.failover.world import PERIOD, Killed, Store, World
from understudy.failover.availability import Availability
from understudy.failover.interfaces import GateState, Instance, NoLongerNeeded, Superseded
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import LOST, recover
from understudy.failover.strategies.base import Choice, Strategy, StrategyContext
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback


async def test_an_executing_standby_takes_over_in_one_commit() -> None:
    store = protected(pool="hot")
    world = World(store)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")
    assert store.commits == ["w-2"], "the gate was committed once, straight from the failed pod to the standby"
    assert store.deleted == ["w-1"], "a policy patch routes, it does not kill"
    assert done.epoch == 2


async def test_the_parts_of_a_recovery_add_up_from_last_healthy_to_routed() -> None:
    world = World(protected(pool="hot"))
    done = await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert sum(done.parts.values()) == pytest.approx(done.moments["routed"] - done.moments["last_healthy"], abs=1e-6)
    assert done.parts["detection"] == pytest.approx(0.5, abs=0.01)
    assert done.parts.get("startup", 0.0) == 0.0, (
        "an executing standby has nothing to start (the paper's t_startup = 0)"
    )


async def test_a_claimed_pod_is_started_behind_a_closed_gate() -> None:
    store = protected(pool="spare", held=True)
    world = World(store)
    done = await recover(failure(world), choices(UninitializedFallback("spare")), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Uninitialized")
    assert store.commits == ["", "w-2"]
    assert store.claims == {"w-2": f"uid-w/{done.id}"}
    assert {"claimed", "fenced", "started", "ready", "routed", "verified"} <= set(done.moments)


async def _recovering_without_a_pool() -> tuple[Store, asyncio.Task[Progress]]:
    """A recovery whose first strategy waits for an answer about a pool, before Restart is tried."""
    store = protected()
    store.unlisted = store.watched = True
    world = World(store)
    recovering = asyncio.create_task(
        recover(failure(world), choices(UninitializedFallback("spare"), Restart()), world.context())
    )
    await asyncio.sleep(VERIFY_WITHIN / 10)
    return store, recovering


async def test_an_instance_that_was_silent_because_somebody_deleted_the_gate_is_not_deleted() -> None:
    store, recovering = await _recovering_without_a_pool()
    store.gate = GateState(epoch=1)  # the operator created it again
    with pytest.raises(NoLongerNeeded):
        await recovering
    assert store.deleted == []


async def test_nobody_is_deleted_while_the_gate_is_missing() -> None:
    store, recovering = await _recovering_without_a_pool()
    store.gateless = True
    await asyncio.sleep(0.5 * VERIFY_WITHIN)  # the first strategy takes a third of it
    assert store.deleted == [], "Restart is tried by now"
    store.gateless, store.gate = False, GateState(epoch=1)  # the operator created it again
    with pytest.raises(NoLongerNeeded):
        await recovering
    assert store.deleted == []


async def test_a_workload_that_loses_a_claim_claims_another_pod() -> None:
    store = protected(pool="spare", held=True)
    store.add("w-3", pool="spare", held=True)
    store.others_claim.add("w-2")
    world = World(store)
    done = await recover(failure(world), choices(UninitializedFallback("spare")), world.context())
    assert done.result == "Recovered"
    assert done.target == PodIdentity(name="w-3", uid="uid-w-3")


async def test_an_empty_pool_leaves_the_gate_unchanged_and_the_next_strategy_is_tried() -> None:
    store = protected()
    world = World(store)
    done = await recover(failure(world), choices(UninitializedFallback("spare"), Restart()), world.context())
    assert [(a.strategy, a.result) for a in done.attempts] == [
        ("Fallback/Uninitialized", "NotAvailable"),
        ("Restart", "Verified"),
    ]
    assert "no pod of FallbackPool spare is ready" in done.attempts[0].message
    assert store.commits == ["", "w-new1"]


async def test_a_restart_never_opens_the_gate_for_the_failed_pod() -> None:
    store = protected()
    world = World(store)
    done = await recover(failure(world), choices(Restart()), world.context())
    assert store.deleted == ["w-1"]
    assert done.target is not None
    assert done.target.name == "w-new1"
    assert "w-1" not in store.commits


async def test_a_standby_that_is_not_verified_is_deleted_and_the_next_strategy_is_tried() -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    world = World(store)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert done.attempts[0].result == "NotVerified"
    assert_golden("failover", done.attempts[0].message, "through the gate")
    assert {"w-1", "w-2"} <= set(store.deleted)


class Waiting(Strategy):
    """Waits for a pod, such as one of a shared pool that the API server does not list."""

    name = "Waiting"

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        return Availability(True)

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        await asyncio.Event().wait()
        raise AssertionError


@pytest.mark.parametrize("between", [[], [Waiting()]], ids=["next", "after one without a pod"])
async def test_an_instance_that_drives_later_than_its_strategy_allows_is_kept_if_it_could_not_be_fenced(
    between: list[Strategy],
) -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    world, running = World(store), asyncio.get_running_loop()
    store.unasked = True
    running.call_later(0.5 * VERIFY_WITHIN, setattr, store, "away", True)
    running.call_later(4 * VERIFY_WITHIN, store.broken.clear)
    running.call_later(6 * VERIFY_WITHIN, setattr, store, "away", False)
    strategies = choices(ExecutingFallback("hot"), *between, Restart())
    done = await recover(failure(world), strategies, world.context())
    assert (done.result, done.strategy, done.to_recovery(1).to_pod) == ("Recovered", "Fallback/Executing", "w-2")
    expected = [("w-2", "NotVerified"), *[("", "NotVerified")] * len(between), ("w-2", "Verified")]
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == expected
    assert (store.commits, store.deleted) == (["w-2", "w-2"], ["w-1"])


async def test_the_gate_records_the_strategy_that_is_being_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    world = World(store)
    context, errors = world.context(), list[str]()
    commit = context.gate.commit

    async def noted(target: Instance | None, progress: Progress | None) -> GateState:
        errors.append(progress.strategy if progress is not None else "")
        return await commit(target, progress)

    monkeypatch.setattr(context.gate, "commit", noted)
    await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), context)
    assert list(dict.fromkeys(errors)) == ["Fallback/Executing", "Restart"]


@pytest.mark.parametrize("loss", ["terminating", "gone"])
async def test_a_lost_standby_is_abandoned_at_once(loss: str) -> None:
    store = protected(pool="spare", held=True)
    store.broken.add("w-2")
    world = World(store)

    def lose() -> None:
        pod = store.pods.pop("w-2")
        if loss == "terminating":
            store.pods["w-2"] = replace(pod, terminating=True)

    asyncio.get_running_loop().call_later(0.2, lose)
    slow = [Choice(UninitializedFallback("spare"), 60.0), Choice(Restart(), VERIFY_WITHIN)]
    started_at = world.clock()
    done = await recover(failure(world), slow, world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert "w-2 is" in done.attempts[0].message
    assert world.clock() - started_at < 20.0, "the time of the first strategy was waited for"


async def test_a_recovery_without_a_verified_instance_fails_with_the_reason() -> None:
    store = protected()
    store.source_makes_broken = True
    world = World(store)
    done = await recover(failure(world), choices(Restart()), world.context())
    assert (done.result, done.strategy) == ("Failed", "")
    assert "within 0.3 s" in done.attempts[0].message


async def test_a_standby_that_is_not_ready_is_not_used() -> None:
    store = protected(pool="hot", ready=False)
    world = World(store)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert done.attempts[0].result == "NotAvailable"
    assert done.attempts[0].message == "w-2: no /cmd_vel for 500 ms"
    assert done.strategy == "Restart"


async def test_a_stale_monitor_does_not_undo_a_newer_epoch() -> None:
    store = protected(pool="hot")
    world = World(store)
    context = world.context()
    store.gate = GateState(epoch=7, active="w-9", active_uid="uid-w-9")
    with pytest.raises(Superseded):
        await recover(failure(world), choices(ExecutingFallback("hot")), context)
    assert store.gate.active == "w-9"


async def test_a_gate_that_is_replaced_during_a_recovery_is_not_the_fault_of_the_instance() -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    store.watched = True
    world = World(store)
    recovering = asyncio.create_task(recover(failure(world), [Choice(ExecutingFallback("hot"), 3.0)], world.context()))
    while not store.commits:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.05)
    store.gate = GateState(epoch=1)  # somebody deleted it, and the operator created it again
    with pytest.raises(Superseded):
        await recovering
    assert store.deleted == []


async def test_without_a_failed_pod_any_ready_instance_takes_over() -> None:
    store = Store()
    store.add("w-2", pool="hot")
    store.gate = GateState(epoch=3, active="w-1", active_uid="uid-w-1")
    world = World(store)
    done = await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert done.result == "Recovered"


@pytest.mark.parametrize(
    ("make", "strategies"),
    [
        pytest.param(lambda: protected(pool="hot"), [ExecutingFallback("hot"), Restart()], id="executing"),
        pytest.param(
            lambda: protected(pool="spare", held=True), [UninitializedFallback("spare"), Restart()], id="uninitialized"
        ),
        pytest.param(protected, [Restart()], id="restart"),
    ],
)
async def test_a_recovery_interrupted_at_any_step_is_finished_by_the_next_monitor(
    make: Callable[[], Store], strategies: list[object]
) -> None:
    whole = World(make())
    await recover(failure(whole), choices(*strategies), whole.context())
    for step in range(whole.effects):
        store = make()
        first = World(store, dies_after=step)
        progress = failure(first)
        with pytest.raises(Killed):
            await recover(progress.model_copy(deep=True), choices(*strategies), first.context())
        kept = store.gate.recovery or store.journal
        second = World(store)
        again = (kept or progress).model_copy(deep=True, update={"resumed": True})
        done = await recover(again, choices(*strategies), second.context())
        assert done.result == "Recovered", f"killed at step {step}"
        assert done.target is not None
        assert store.drives(done.target.name), f"killed at step {step}: the robot is driven by the recorded instance"
        assert "w-1" not in store.pods, f"killed at step {step}: the failed pod was left running"
        assert len(store.claims) <= 1, f"killed at step {step}: claimed more than one pod"
        assert store.commits.count(done.target.name) == 1, f"killed at step {step}: routed more than once"


@pytest.mark.parametrize("strategy", [ExecutingFallback("hot"), InitializedFallback("hot")])
async def test_an_instance_that_lost_its_label_after_the_last_monitor_let_it_through_is_not_fenced(
    strategy: ExecutingFallback,
) -> None:
    store = protected(pool="hot")
    strategies = choices(strategy, Restart())
    first = World(store)
    killed = asyncio.create_task(recover(failure(first), strategies, first.context()))
    while store.gate.active != "w-2":
        await asyncio.sleep(0)
    killed.cancel()
    assert store.gate.recovery is not None
    store.unlabelled.add("w-2")
    done = await recover(store.gate.recovery.model_copy(deep=True), strategies, World(store).context())
    assert (done.result, done.strategy) == ("Recovered", strategy.name)
    assert store.commits.count("w-2") == 1, "it drove already"
    assert store.deleted == ["w-1"]


async def test_an_instance_that_loses_its_label_while_it_is_verified_is_not_lost() -> None:
    store = protected(pool="spare", held=True)
    store.broken.add("w-2")  # until it has been without its label for a while
    world = World(store)

    async def edit() -> None:
        while store.gate.active != "w-2":
            await asyncio.sleep(PERIOD)
        store.unlabelled.add("w-2")
        await asyncio.sleep(LOST + 1.0)
        store.broken.discard("w-2")

    editing = asyncio.create_task(edit())
    slow = [Choice(UninitializedFallback("spare"), 60.0), Choice(Restart(), VERIFY_WITHIN)]
    done = await recover(failure(world), slow, world.context())
    await editing
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Uninitialized")


async def test_a_held_strategy_is_skipped_and_claims_nothing() -> None:
    store = protected(pool="spare", held=True)
    world = World(store)
    context = replace(
        world.context(), holds=lambda strategy: "others fail too" if not strategy.has_own_instance else None
    )
    done = await recover(failure(world), choices(UninitializedFallback("spare"), Restart()), context)
    assert done.result == "Failed"
    assert [(a.result, a.message) for a in done.attempts] == [("NotAvailable", "others fail too")] * 2
    assert (store.commits, store.deleted) == ([], []), "nothing was claimed, fenced or deleted"


async def test_a_recovery_that_a_previous_monitor_started_is_not_held() -> None:
    store = protected(pool="hot")
    world = World(store)
    progress = failure(world)
    progress.target = PodIdentity(name="w-2", uid="uid-w-2")
    done = await recover(progress, choices(ExecutingFallback("hot")), replace(world.context(), holds=lambda _: "held"))
    assert done.result == "Recovered"


async def test_a_standby_that_a_previous_monitor_only_chose_is_not_deleted_if_its_agent_does_not_answer() -> None:
    store = protected(pool="hot")
    store.pods["w-2"] = replace(store.pods["w-2"], ready=False)  # by its agent
    world = World(store)
    progress = failure(world)
    progress.target = PodIdentity(name="w-2", uid="uid-w-2")
    done = await recover(progress, choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")
    assert store.deleted == ["w-1"]


async def test_an_outage_of_the_api_server_fails_no_standby() -> None:
    store = protected(pool="hot")
    world, store.away = World(store), True
    asyncio.get_running_loop().call_later(3 * VERIFY_WITHIN, setattr, store, "away", False)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "Verified")]
    assert (store.commits, store.deleted) == (["w-2"], ["w-1"])
    assert re.fullmatch("the API server did not answer for (0.[89]|1.0) s", done.attempts[0].message)


async def test_a_monitor_that_has_discovered_nobody_yet_fails_no_standby() -> None:
    store = protected(pool="hot")
    world, store.blind = World(store), True
    asyncio.get_running_loop().call_later(3 * VERIFY_WITHIN, setattr, store, "blind", False)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "Verified")]
    assert (store.commits, store.deleted) == (["w-2"], ["w-1"]), "it is not fenced while it may drive"
    assert re.fullmatch("DDS discovery reported nobody to the monitor for (0.[89]|1.0) s", done.attempts[0].message)


async def test_a_standby_that_is_lost_is_given_up_also_by_a_monitor_that_has_discovered_nobody() -> None:
    store = protected(pool="hot")
    world, store.blind = World(store), True
    gone = lambda: store.pods.__setitem__("w-2", replace(store.pods["w-2"], terminating=True))  # noqa: E731
    asyncio.get_running_loop().call_later(2 * VERIFY_WITHIN, gone)
    asyncio.get_running_loop().call_later(4 * VERIFY_WITHIN, setattr, store, "blind", False)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Restart")


async def test_no_instance_is_asked_for_test_packets_before_an_api_server_that_was_away_has_committed() -> None:
    store = protected(pool="hot")
    world, store.away = World(store), True
    recovering = asyncio.create_task(recover(failure(world), choices(ExecutingFallback("hot")), world.context()))
    await asyncio.sleep(VERIFY_WITHIN)
    assert not store.probed, "the gate may have been switched by another monitor meanwhile"
    store.away = False
    await recovering
    assert "uid-w-2" in store.probed


async def test_time_in_which_the_monitor_is_stalled_fails_no_standby() -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    world, loop = World(store), asyncio.get_running_loop()
    loop.call_later(0.02, time.sleep, 2 * VERIFY_WITHIN)
    loop.call_later(2 * VERIFY_WITHIN + 0.1, store.broken.clear)
    done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "Verified")]


async def test_a_strategy_has_its_whole_time_again_after_an_outage_and_no_more() -> None:
    store = protected(pool="hot")
    store.broken.add("w-2")
    world, store.away = World(store), True
    loop = asyncio.get_running_loop()
    loop.call_later(2 * VERIFY_WITHIN, setattr, store, "away", False)
    began = loop.time()
    done = await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert done.result == "Failed"
    assert re.search("; the API server did not answer for 0.[567] s, which do not count$", done.attempts[0].message)
    assert 2.5 * VERIFY_WITHIN <= loop.time() - began <= 4.5 * VERIFY_WITHIN


@pytest.mark.parametrize("problem", [{"unlisted": True}, {"list_refusal": "403 Forbidden"}])
async def test_the_next_strategy_is_tried_if_only_the_pods_of_a_pool_cannot_be_listed(problem: dict[str, Any]) -> None:
    store = replace(protected(pool="spare", held=True), **problem)
    world = World(store)
    async with asyncio.timeout(5):
        done = await recover(failure(world), choices(UninitializedFallback("spare"), Restart()), world.context())
    assert [(attempt.strategy, attempt.result) for attempt in done.attempts] == [
        ("Fallback/Uninitialized", "NotAvailable"),
        ("Restart", "Verified"),
    ]
    assert problem.get("list_refusal", "did not list") in done.attempts[0].message


@pytest.mark.parametrize("after", [{"unlisted": False}, {"unlisted": False, "list_refusal": "403: no roles yet"}])
async def test_a_pool_that_cannot_be_listed_during_an_outage_is_used_after_it(after: dict[str, Any]) -> None:
    store = protected(pool="spare", held=True)
    world, store.away, store.unlisted = World(store), True, True
    loop = asyncio.get_running_loop()
    for name, value in (after | {"away": False}).items():
        loop.call_later(2 * VERIFY_WITHIN, setattr, store, name, value)
    loop.call_later(2 * VERIFY_WITHIN + 0.02, setattr, store, "list_refusal", "")
    ladder = [Choice(UninitializedFallback("spare"), 4 * VERIFY_WITHIN), Choice(Restart(), VERIFY_WITHIN)]
    done = await recover(failure(world), ladder, world.context())
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "Verified")]


async def test_a_refused_claim_leaves_no_pending_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    # A commit that is carried out after the recovery was given up would look to the next one like another writer's.
    store = protected(pool="spare", held=True)
    world = World(store)
    context, store.away = world.context(), True

    async def refuse(instance: Instance, claim: str) -> Instance:
        asyncio.get_running_loop().call_later(0.05, setattr, store, "away", False)
        raise PermissionError("401: the API server doesn't know the roles again yet")

    monkeypatch.setattr(context.instances, "claim", refuse)
    with pytest.raises(PermissionError):
        await recover(failure(world), choices(UninitializedFallback("spare")), context)
    given_up = list(store.commits)
    await asyncio.sleep(0.2)
    assert store.commits == given_up == [""]
