"""The robot's readers chose a standby: that is noticed from samples alone, committed, and never charged to the cluster."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from tests.unit.failover.world import Killed, Store, World
from understudy.failover import reflex
from understudy.failover.interfaces import GateState
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.reflex import ReflexFallback, ReflexSwitch, longest_gap, measured, switched
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart

DEADLINE = 0.1
W1, W2 = PodIdentity(name="w-1", uid="uid-w-1"), PodIdentity(name="w-2", uid="uid-w-2")


def every(period: float, start: float, end: float) -> list[float]:
    return [start + period * i for i in range(int((end - start) / period + 1e-9) + 1)]


# -- noticing ------------------------------------------------------------------------------------------------------


def detected(active: list[float], standby: list[float], now: float) -> tuple[float, float] | None:
    return switched(active, standby, deadline=DEADLINE, now=now)


def test_a_standby_whose_output_arrives_after_the_deadline_drives() -> None:
    assert detected(every(0.05, 1, 2), [2.13], 2.14) == (2.0, 2.13)


def test_no_standby_drives_while_output_of_the_active_instance_arrives() -> None:
    assert detected(every(0.05, 1, 2), [], 2.3) is None, "silence alone is the health tree's business"
    assert detected(every(0.05, 1, 2), [0.9], 2.01) is None, "what was before its last output"
    assert detected([*every(0.05, 1, 2), 2.14], [2.12], 2.2) is None, "it was late once and took the robot back"


def test_a_writer_that_left_gives_way_at_once_but_must_stay_silent() -> None:
    assert detected(every(0.05, 1, 2), [2.02, 2.07], 2.08) is None
    assert detected(every(0.05, 1, 2), [2.02, 2.07], 2.11) == (2.0, 2.02)


def test_a_standby_that_is_first_after_a_pause_drives_only_after_a_deadline() -> None:
    assert detected(every(0.05, 1, 2), [9.0], 9.02) is None
    assert detected(every(0.05, 1, 2), [9.0, 9.05], 9.11) == (2.0, 9.0)


def test_no_standby_drives_before_the_first_output_of_the_active_instance() -> None:
    assert detected([], every(0.05, 5, 9), 9.01) is None, "a monitor that starts may discover the standby first"


def test_a_period_longer_than_the_deadline_is_reported() -> None:
    assert longest_gap(every(0.05, 0, 5), DEADLINE) is None
    assert longest_gap(every(0.15, 0, 5), DEADLINE) == pytest.approx(0.15)
    late = every(0.05, 0, 5)
    del late[50:52]
    assert longest_gap(late, DEADLINE) is None, "late once in a while is no period"
    assert measured(every(0.05, 0, 5), 5.1)
    assert not measured(every(0.05, 0, 1), 1.1)
    assert not measured(every(0.05, 0, 5), 60.0), "nothing of late"


# -- committing ----------------------------------------------------------------------------------------------------


def fallen_over() -> Store:
    store = Store()
    store.add("w-1")
    store.add("w-2", pool="hot")
    store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1", admitted="w-2", admitted_uid="uid-w-2")
    store.broken.add("w-1")
    return store


def reflex_progress(world: World) -> Progress:
    now = world.clock()
    return reflex.begin(ReflexSwitch(W2, last=now - 0.13, first=now - 0.005), W1, DEADLINE)


@pytest.mark.parametrize("switcher", ["the robot's readers", "the mux"])
def test_the_reason_names_who_switched(switcher: str) -> None:
    found = reflex.begin(ReflexSwitch(W2, last=1.0, first=1.1), W1, DEADLINE, switcher)
    assert f"so {switcher} switched to {W2.name}" in found.reason


async def carried_out(progress: Progress, world: World) -> Progress:
    await reflex.commit(progress, world.context())
    choices = [Choice(ReflexFallback(), 0.3), Choice(ExecutingFallback("hot"), 0.3), Choice(Restart(), 0.3)]
    return await recover(progress, choices, world.context())


async def test_a_takeover_is_committed_once_and_only_the_detection_counts() -> None:
    world = World(fallen_over())
    done = await carried_out(reflex_progress(world), world)
    assert (done.result, done.strategy, done.epoch) == ("Recovered", "Fallback/Executing (reflex)", 2)
    assert world.store.commits == ["w-2"]
    beside = world.store.gate.recovery
    assert beside is not None
    assert beside.strategy == "Fallback/Executing (reflex)", "as it was committed"
    assert world.store.deleted == world.store.gave_way == ["w-1"]
    recovery = done.to_recovery(1)
    assert recovery.parts is not None
    assert (recovery.parts.cluster, recovery.parts.startup, recovery.parts.reinitialization) == (0, 0, 0)
    assert recovery.parts.detection == recovery.recovery_seconds == pytest.approx(0.125)
    assert (recovery.from_pod, recovery.to_pod) == ("w-1", "w-2")
    assert done.moments["routed"] == done.moments["first_output"] < done.moments["fenced"]


async def test_a_slow_api_server_delays_only_the_commit() -> None:
    world = World(fallen_over())
    context = world.context()
    commit = context.gate.commit

    async def late(*arguments: object) -> GateState:
        await asyncio.sleep(0.7)  # longer than any strategy may take
        return await commit(*arguments)  # type: ignore[arg-type]

    context.gate.commit = late  # type: ignore[method-assign]
    progress = reflex_progress(world)
    await reflex.commit(progress, context)
    done = await recover(progress, [Choice(ReflexFallback(), 0.3), Choice(Restart(), 0.3)], context)
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing (reflex)")
    assert sum(done.parts.values()) == pytest.approx(0.125)


async def test_a_standby_that_stops_before_the_commit_is_replaced_by_the_next_strategy() -> None:
    store = fallen_over()
    store.pods["w-2"] = replace(store.pods["w-2"], running=False)
    store.add("w-3", pool="hot")
    world = World(store)
    done = await carried_out(reflex_progress(world), world)
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")
    assert done.target == PodIdentity(name="w-3", uid="uid-w-3")
    assert [attempt.result for attempt in done.attempts] == ["NotAvailable", "Verified"]
    assert sum(done.parts.values()) == pytest.approx(done.moments["routed"] - done.moments["last_healthy"])


async def test_a_standby_that_took_over_and_was_replaced_at_the_robot_since_is_not_recorded_as_the_driver() -> None:
    store = fallen_over()
    store.add("w-3", pool="hot")
    store.switched["w-2"] = "w-3"
    done = await carried_out(reflex_progress(World(store)), World(store))
    assert [(attempt.pod, attempt.result) for attempt in done.attempts] == [("w-2", "NotVerified"), ("w-3", "Verified")]
    assert "the robot's side switched to w-3 by itself" in done.attempts[0].message
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")


async def test_a_standby_that_took_over_and_lost_its_label_is_not_fenced() -> None:
    store = fallen_over()
    store.add("w-3", pool="hot")
    store.unlabelled.add("w-2")
    done = await carried_out(reflex_progress(World(store)), World(store))
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing (reflex)")
    assert store.commits == ["w-2"]
    assert not store.unlabelled


async def test_a_takeover_interrupted_at_any_step_is_finished_by_the_next_monitor() -> None:
    whole = World(fallen_over())
    await carried_out(reflex_progress(whole), whole)
    for step in range(whole.effects):
        store = fallen_over()
        first = World(store, dies_after=step)
        progress = reflex_progress(first)
        with pytest.raises(Killed):
            await carried_out(progress.model_copy(deep=True), first)
        kept = store.gate.recovery or store.journal or progress
        done = await carried_out(kept.model_copy(deep=True, update={"resumed": True}), World(store))
        assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing (reflex)"), f"killed at step {step}"
        assert store.commits == ["w-2"], f"killed at step {step}"
        assert "w-1" not in store.pods, f"killed at step {step}"


async def test_an_ordinary_fallback_uses_the_admitted_standby() -> None:
    store = fallen_over()
    store.add("w-0", pool="hot", created="2020-01-01T00:00:00Z")
    world = World(store)
    now = world.clock()
    progress = Progress.begin("no /scan", last_healthy=now - 1, detected=now, failed=[W1])
    done = await recover(progress, [Choice(ExecutingFallback("hot"), 0.3)], world.context())
    assert done.target == W2
