"""After a commit, an instance counts as the only driver once everybody else was silent for one of their periods and a margin."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import pytest

from tests.unit.failover.recoveries import choices, failure, protected
from tests.unit.failover.test_switchover import driven, switched
from tests.unit.failover.world import Leak, Store, World
from understudy.failover import protocol
from understudy.failover.interfaces import GateState, Superseded
from understudy.failover.progress import Progress
from understudy.failover.protocol import SILENCE_MARGIN, STALL, recover
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart

SILENT_WITHIN = 1.0


@pytest.fixture
def _short_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "SILENT_WITHIN", SILENT_WITHIN)


async def _recovered(store: Store, world: World) -> Progress:
    return await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), world.context())


async def test_a_fenced_pod_that_sends_slowly_past_the_gate_is_heard_before_the_recovery_counts() -> None:
    store = protected(pool="hot")
    world = World(store)
    began = world.clock()
    store.leaks["w-1"] = Leak(0.3, began - 0.2, until=began + 0.8)  # so one look right after the switch sees nothing
    done = await _recovered(store, world)
    assert done.result == "Recovered"
    assert done.moments["verified"] >= began + 0.7 + 0.3 + SILENCE_MARGIN - 0.02
    assert done.moments["fenced"] >= began + 0.69, "the record says when it was really fenced"


async def test_a_pod_that_is_heard_while_a_slow_api_server_deletes_it_is_not_silent() -> None:
    store = protected(pool="hot")
    world = World(store)
    began, store.deletion_takes = world.clock(), 2 * SILENCE_MARGIN
    store.leaks["w-1"] = Leak(0.02, began, until=began + 0.6)
    done = await _recovered(store, world)
    assert done.moments["verified"] >= began + 0.58 + SILENCE_MARGIN


async def test_a_deletion_without_an_answer_does_not_fail_the_instance_that_drives() -> None:
    store = protected(pool="hot")
    world = World(store)
    store.leaks["w-1"], store.unanswered_deletions = Leak(0.02, world.clock(), until=world.clock() + 0.1), 1
    done = await _recovered(store, world)
    assert [(a.pod, a.result) for a in done.attempts] == [("w-2", "Verified")]
    assert (store.commits, store.deleted) == (["w-2"], ["w-1"]), "it is deleted again at the end"


async def test_probes_of_a_fenced_pod_that_pass_are_a_leak_too() -> None:
    store = protected(pool="hot")
    world = World(store)
    began = world.clock()
    store.probes_through["uid-w-1"] = Leak(0.01, began, until=began + 0.5)
    done = await _recovered(store, world)
    assert done.moments["verified"] >= began + 0.49 + SILENCE_MARGIN
    assert store.deleted == ["w-1"]


async def test_a_standby_whose_rare_probes_pass_is_heard_before_the_recovery_counts() -> None:
    store = protected(pool="hot")
    store.add("w-3", pool="hot", ready=False)
    world = World(store)
    began = world.clock()
    store.probes_through["uid-w-3"] = Leak(1.0, began - 0.5, until=began + 0.8)  # one probe at 0.5 s
    done = await _recovered(store, world)
    assert done.moments["verified"] >= began + 0.8 - 0.01 + SILENCE_MARGIN
    assert store.deleted == ["w-1"], "the standby has not failed"


@pytest.mark.usefixtures("_short_patience")
async def test_a_leak_that_lasts_is_never_recorded_as_recovered_and_the_next_instance_stays() -> None:
    store = protected(pool="hot")
    world = World(store)
    began = world.clock()
    store.leaks["w-1"] = Leak(0.05, began)
    done = await _recovered(store, world)
    assert done.result == "Failed"
    assert world.clock() - began >= SILENT_WITHIN
    assert [(a.strategy, a.result) for a in done.attempts] == [("Fallback/Executing", "NotVerified")], (
        "no other is tried"
    )
    assert "w-1" in done.attempts[0].message
    assert store.deleted == ["w-1"], "the understudy has not failed"
    assert "verified" not in done.moments


async def test_a_leak_does_not_end_the_time_in_which_the_strategy_must_be_verified() -> None:
    store = protected(pool="hot")
    world = World(store)
    store.leaks["w-1"] = Leak(0.05, world.clock(), until=world.clock() + 1.0)  # VERIFY_WITHIN is 0.3 s
    assert (await _recovered(store, world)).result == "Recovered"


async def test_nobody_else_heard_costs_one_period_and_the_margin() -> None:
    store = protected(pool="hot")
    world = World(store)
    done = await _recovered(store, world)
    assert SILENCE_MARGIN <= done.moments["verified"] - done.moments["fenced"] < SILENCE_MARGIN + 0.1


@pytest.mark.usefixtures("_short_patience")
async def test_a_switchover_whose_former_instance_goes_on_sending_is_not_recorded_as_done() -> None:
    store = driven(pool="hot")
    world = World(store)
    store.leaks["w-1"] = Leak(0.05, world.clock())
    done = await switched(world, ExecutingFallback("hot"))
    assert (done.result, done.target and done.target.name) == ("Failed", "w-2")
    assert store.deleted == ["w-1"]


READ_LATE = 0.03
"""Seconds after a stall after which the samples and watch events of that time are read."""


def _stall(read: Callable[[], None]) -> None:
    """Stall the monitor while it listens to the others. What happened meanwhile is read a moment after that."""
    loop = asyncio.get_running_loop()

    def stall() -> None:
        time.sleep(2 * STALL)
        loop.call_later(READ_LATE, read)

    loop.call_later(SILENCE_MARGIN / 2, stall)


async def test_a_pod_that_sent_while_the_monitor_was_stalled_was_not_silent() -> None:
    store = protected(pool="hot")
    world = World(store)
    sent = Leak(0.02, world.clock(), until=world.clock() + SILENCE_MARGIN + 2 * STALL)
    _stall(lambda: store.leaks.update({"w-1": sent}))
    done = await _recovered(store, world)
    assert done.moments["verified"] >= sent.until - sent.period + SILENCE_MARGIN
    assert store.deleted == ["w-1"]


@pytest.mark.usefixtures("_short_patience")
async def test_a_stall_of_the_monitor_does_not_use_up_the_time_within_which_others_must_be_silent() -> None:
    store = protected(pool="hot")
    world = World(store)
    store.leaks["w-1"] = Leak(0.02, world.clock(), until=world.clock() + 0.1)
    asyncio.get_running_loop().call_later(0.1 + SILENCE_MARGIN / 2, time.sleep, 1.2 * SILENT_WITHIN)
    assert (await _recovered(store, world)).result == "Recovered"


async def test_a_recovery_whose_gate_was_changed_during_a_stall_of_its_monitor_is_superseded() -> None:
    store = protected(pool="hot")
    world = World(store)

    def read() -> None:
        store.gate, store.watched = GateState(epoch=3, active="w-3", active_uid="uid-w-3"), True

    _stall(read)
    with pytest.raises(Superseded, match="w-3"):
        await _recovered(store, world)


async def test_a_monitor_that_continues_a_recovery_listens_to_the_others_itself() -> None:
    store = protected(pool="hot")
    await _recovered(store, World(store))
    continued = store.journal
    assert continued is not None
    continued.result, continued.attempts = "Running", []
    continued.moments = {name: moment - 10 for name, moment in continued.moments.items() if name != "verified"}
    world = World(store)
    began = world.clock()
    sent = Leak(0.05, began + 0.03, until=began + 0.2)
    store.leaks["w-1"] = sent
    done = await recover(continued, choices(ExecutingFallback("hot"), Restart()), world.context())
    assert done.result == "Recovered"
    assert done.moments["verified"] >= began + 0.13 + SILENCE_MARGIN


async def test_a_recovery_ends_although_the_monitor_is_stalled_again_and_again() -> None:
    """As on a node without free processors. The others send at 1 Hz: there is no stall-free second in which they could be silent."""
    store = protected(pool="hot")
    world = World(store)
    context = world.context()
    context.outputs.period_of_others = lambda instance: 1.0  # type: ignore[method-assign]
    loop = asyncio.get_running_loop()

    def stall() -> None:
        time.sleep(1.1 * STALL)
        loop.call_later(0.05, stall)

    loop.call_later(0.02, stall)
    async with asyncio.timeout(30):
        done = await recover(failure(world), choices(ExecutingFallback("hot"), Restart()), context)
    assert done.result == "Recovered"
