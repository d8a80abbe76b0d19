"""A planned switchover: who drives at every moment of it, and who is left when it comes to nothing or its monitor dies."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.support.golden import assert_golden
from tests.unit.failover.world import Killed, Store, World
from understudy.api.protocol.kept_state import KeptSample, KeptState
from understudy.failover import switchover
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import GateState, Instance, NotAvailable, Superseded
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import Choice, Strategy
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback
from understudy.failover.switchover import Preparation, prepare, settle, switch

BRING_UP = BringUp("bringUp", {}, 0.2, "digest", False)
WITHIN = 0.3
PATIENT = 10.0
"""Seconds for a preparation that succeeds at once on a machine that is not busy."""


def driven(**standby: object) -> Store:
    """A robot that w-1 drives, which is well."""
    store = Store(beside=True)
    store.add("w-1")
    store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
    store.kept = KeptState(
        (KeptSample("/amcl_pose", "geometry_msgs/msg/Pose", -1.0, b"pose", to="/initialpose"),), (), (), ()
    )
    if standby:
        store.add("w-2", **standby)
    return store


def anything(instance: Instance) -> str | None:
    return None


def planned(world: World) -> Progress:
    now = world.clock()
    progress = Progress.begin("somebody asked for it", last_healthy=now, detected=now, planned=True)
    progress.switchover, progress.request = "Failover", "failover 2026-11-22T14:02:11Z"
    return progress


async def prepared_by(
    world: World, *strategies: Strategy, unfit: switchover.Unfit = anything, within: float = WITHIN
) -> Preparation:
    choices = [Choice(strategy, within) for strategy in strategies]
    return await prepare(planned(world), choices, world.context(), unfit)


async def switched(world: World, *strategies: Strategy, within: float = WITHIN) -> Progress:
    return await switch(await prepared_by(world, *strategies, within=within), world.context())


STRATEGIES: Sequence[tuple[Strategy, dict[str, object]]] = (
    (ExecutingFallback("hot"), {"pool": "hot"}),
    (InitializedFallback("warm", recovery=BRING_UP), {"pool": "warm"}),
    (UninitializedFallback("spare", recovery=BRING_UP), {"pool": "spare", "held": True}),
)
EACH = pytest.mark.parametrize(("strategy", "standby"), STRATEGIES, ids=["executing", "initialized", "uninitialized"])


@EACH
async def test_the_gate_is_committed_once_and_never_closed(strategy: Strategy, standby: dict[str, object]) -> None:
    store = driven(**standby)
    done = await switched(World(store), strategy)
    assert (done.result, store.gate.active, store.gate.epoch) == ("Recovered", "w-2", 2)
    assert store.commits == ["w-2"]
    assert store.deleted == ["w-1"], "the former instance goes once the next one was seen to drive"


@EACH
async def test_the_gate_does_not_change_before_the_robot_s_side_hears_the_standby(
    strategy: Strategy, standby: dict[str, object]
) -> None:
    store = driven(**standby)
    store.heard_after = 2 * WITHIN
    world = World(store)
    preparing = asyncio.create_task(prepared_by(world, strategy))
    await asyncio.sleep(1.5 * WITHIN)
    assert not preparing.done()
    assert (await preparing).target is not None


async def test_a_standby_that_sends_nothing_takes_over_nevertheless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(switchover, "HEARD_WITHIN", 0.1)
    store = driven(pool="hot")
    store.heard_after = 60.0
    done = await switched(World(store), ExecutingFallback("hot"))
    assert done.result == "Recovered"


@EACH
async def test_the_gate_does_not_change_before_the_standby_can_drive(
    strategy: Strategy, standby: dict[str, object]
) -> None:
    store = driven(**standby)
    found = await prepared_by(World(store), strategy)
    assert found.target is not None
    assert found.target.name == "w-2"
    assert (store.gate.active, store.commits, store.deleted) == ("w-1", [], [])
    assert store.journal is None, "a new monitor has nothing to go on with: it begins anew"


async def test_an_initialized_standby_is_brought_up_with_fresh_state_before_the_switch() -> None:
    store = driven(pool="warm")
    done = await switched(World(store), InitializedFallback("warm", recovery=BRING_UP))
    assert store.kept_states == {"w-2": store.kept}
    assert store.brought_up == [("w-2", "bringUp")]
    assert [(entry.name, entry.restored) for entry in done.to_recovery(1).state] == [("/amcl_pose", True)]


async def test_the_record_of_a_switchover_excludes_its_preparation() -> None:
    world = World(driven(pool="spare", held=True))
    recovery = (await switched(world, UninitializedFallback("spare", recovery=BRING_UP))).to_recovery(4)
    assert (recovery.planned, recovery.switchover) == (True, "Failover")
    assert (recovery.from_pod, recovery.to_pod, recovery.epoch) == ("w-1", "w-2", 2)
    assert recovery.parts is not None
    assert (recovery.parts.detection, recovery.parts.startup, recovery.parts.reinitialization) == (0.0, 0.0, 0.0)
    assert recovery.moments.last_output is not None
    assert [(a.strategy, a.result) for a in recovery.attempts] == [("Fallback/Uninitialized", "Verified")]


async def test_the_start_of_the_standby_is_not_recorded() -> None:
    done = await switched(World(driven(pool="warm")), InitializedFallback("warm", recovery=BRING_UP))
    assert "started" not in done.moments, "long ago"
    assert "ready" in done.moments


async def test_without_a_ready_standby_nothing_changes_and_the_reason_is_reported() -> None:
    store = driven(pool="hot", ready=False)
    found = await prepared_by(World(store), ExecutingFallback("hot"), UninitializedFallback("spare"), Restart())
    assert found.target is None
    assert found.passing
    assert "Fallback/Executing: w-2: no /cmd_vel for 500 ms" in found.reason
    assert_golden("failover", found.reason, "Fallback/Uninitialized", "FallbackPool spare")
    assert "Restart: it cannot be used for a planned switchover" in found.reason
    assert (store.gate.active, store.commits, store.deleted) == ("w-1", [], [])


async def test_a_standby_that_is_not_ready_in_time_is_deleted_and_the_next_strategy_is_tried() -> None:
    store = driven(pool="warm")
    store.broken.add("w-2")
    store.add("w-3", pool="spare", held=True)
    world = World(store)
    found = await prepared_by(world, InitializedFallback("warm", recovery=BRING_UP), UninitializedFallback("spare"))
    assert found.target is not None
    assert found.target.name == "w-3"
    assert (store.gate.active, store.commits, store.deleted) == ("w-1", [], ["w-2"])
    assert "was ready within 0.3 s" in found.attempts[0].message


async def test_a_failed_procedure_is_reported_and_nothing_changes() -> None:
    store = driven(pool="warm")
    store.unwilling.add("w-2")
    found = await prepared_by(World(store), InitializedFallback("warm", recovery=BRING_UP))
    assert not found.passing
    assert "node /amcl is gone" in found.reason
    assert (store.gate.active, store.commits) == ("w-1", [])


@EACH
async def test_an_unsuitable_instance_is_not_used(strategy: Strategy, standby: dict[str, object]) -> None:
    store = driven(**standby, node="node-2")
    world = World(store)
    found = await prepared_by(world, strategy, unfit=lambda i: "is on node-2" if i.node == "node-2" else None)
    assert found.target is None
    assert found.reason == f"{strategy.name}: w-2 is on node-2"
    store.add("w-3", **standby, node="node-3")
    found = await prepared_by(world, strategy, unfit=lambda i: "is on node-2" if i.node == "node-2" else None)
    assert found.target is not None
    assert found.target.name == "w-3"


async def test_the_gate_returns_to_the_former_instance_if_the_robot_receives_no_output(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(switchover, "SEEN_WITHIN", 0.1)
    store = driven(pool="hot")
    store.broken.add("w-2")
    done = await switched(World(store), ExecutingFallback("hot"))
    assert (done.result, store.gate.active) == ("Failed", "w-1")
    assert store.commits == ["w-2", "w-1"]
    assert store.deleted == ["w-2"], "the former one drives on; that one is of no use"
    recovery = done.to_recovery(1)
    assert (recovery.result, recovery.from_pod, recovery.strategy) == ("Failed", "w-1", "")
    assert recovery.attempts[-1].message == "no output of w-2 arrived within 0.1 s"
    assert [pod.name for pod in done.replaced] == ["w-2"], "the former one isn't one that was replaced"


async def test_the_gate_stays_if_the_former_instance_is_missing_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(switchover, "SEEN_WITHIN", 0.1)
    store = driven(pool="hot")
    store.broken.add("w-2")
    world = World(store)
    found = await prepared_by(world, ExecutingFallback("hot"))
    store.pods.pop("w-1")
    done = await switch(found, world.context())
    assert (done.result, store.gate.active, store.deleted) == ("Failed", "w-2", [])


async def test_the_understudy_receives_the_state_of_the_moment_of_the_switch() -> None:
    store = driven(pool="warm")
    world = World(store)
    found = await prepared_by(world, InitializedFallback("warm"))
    at_preparation = store.kept_states["w-2"]
    store.kept = KeptState(
        (KeptSample("/amcl_pose", "geometry_msgs/msg/Pose", 5.0, b"later", to="/initialpose"),), (), (), ()
    )
    done = await switch(found, world.context())
    assert done.result == "Recovered"
    assert store.kept_states["w-2"] == store.kept != at_preparation


async def test_a_switchover_does_not_wait_for_a_silent_api_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(switchover, "COMMIT_WITHIN", 0.05)
    store = driven(pool="hot")
    world = World(store)
    found = await prepared_by(world, ExecutingFallback("hot"))
    store.away = True
    with pytest.raises(TimeoutError):
        await switch(found, world.context())
    assert (store.gate.active, store.deleted) == ("w-1", [])


async def test_a_commit_of_another_monitor_takes_precedence() -> None:
    store = driven(pool="hot")
    world = World(store)
    found, context = await prepared_by(world, ExecutingFallback("hot")), world.context()
    store.gate = replace(store.gate, epoch=2)
    with pytest.raises(Superseded):
        await switch(found, context)
    assert store.deleted == []


async def test_a_superseded_switchover_changes_nothing() -> None:
    store = driven(pool="hot")
    world = World(store)
    progress = planned(world)
    progress.target = progress.former = None
    with pytest.raises(Superseded):
        await settle(progress, world.context())


async def test_a_failback_starts_a_pod_of_the_workload_controller_and_switches_to_it() -> None:
    store = driven()
    store.pods.clear()
    store.add("s-1", pool="spare", claim="uid-w/1")
    store.started.add("s-1")
    store.gate = GateState(epoch=5, active="s-1", active_uid="uid-s-1")
    world = World(store)
    home = Restart(recovery=BRING_UP)
    found = await prepared_by(world, home)
    assert found.target is not None
    assert found.target.from_source
    assert (store.gate.active, store.commits) == ("s-1", [])
    assert store.brought_up == [(found.target.name, "bringUp")]
    done = await switch(found, world.context())
    assert (done.result, store.gate.active, store.deleted) == ("Recovered", found.target.name, ["s-1"])


@EACH
async def test_a_switchover_interrupted_at_any_step_leaves_one_active_instance_and_is_finished(
    strategy: Strategy, standby: dict[str, object]
) -> None:
    for step in range(60):
        store = driven(**standby)
        store.add("w-9", **standby)
        world = World(store, dies_after=step)
        try:
            done = await switched(world, strategy, within=PATIENT)
        except Killed:
            assert store.gate.active in ("w-1", "w-2", "w-9"), f"killed at step {step}"
            assert store.gate.active in store.pods, f"killed at step {step}: who is let through runs"
            # As the next monitor does: it settles what was committed, and starts everything else again.
            context = World(store).context()
            unfinished = store.journal if store.journal is not None else store.gate.recovery
            if unfinished is not None and (unfinished.result != "Running" or switchover.committed(unfinished, context)):
                done = await settle(unfinished.model_copy(deep=True), context)
            else:
                done = await switched(World(store), strategy, within=PATIENT)
        assert done.result == "Recovered", f"killed at step {step}"
        assert store.commits.count("") == 0, f"killed at step {step}: the gate was closed"
        assert len([c for c in store.commits if c]) == 1, f"killed at step {step}: {store.commits}"
        assert "w-1" not in store.pods, f"killed at step {step}"
        if world.effects <= step:
            assert step > 4
            return
    pytest.fail("the switchover never came to its end")


async def test_a_preparation_can_be_cancelled() -> None:
    store = driven(pool="warm")
    store.broken.add("w-2")
    world = World(store)
    task = asyncio.create_task(prepared_by(world, InitializedFallback("warm", recovery=BRING_UP)))
    await asyncio.sleep(0.05)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert (store.gate.active, store.commits, store.deleted) == ("w-1", [], [])


async def test_a_standby_that_disappears_before_the_switch_changes_nothing() -> None:
    store = driven(pool="hot")
    world = World(store)
    found = await prepared_by(world, ExecutingFallback("hot"))
    store.pods.pop("w-2")
    with pytest.raises(NotAvailable, match="w-2, which was ready, is gone"):
        await switch(found, world.context())
    assert (store.gate.active, store.commits) == ("w-1", [])


@EACH
async def test_a_standby_that_is_no_longer_ready_does_not_get_control(
    strategy: Strategy, standby: dict[str, object]
) -> None:
    store = driven(**standby)
    world = World(store)
    found = await prepared_by(world, strategy)
    store.pods["w-2"] = replace(store.pods["w-2"], ready=False)
    with pytest.raises(NotAvailable, match="w-2, which was ready, is not ready any more: no /cmd_vel for 500 ms"):
        await switch(found, world.context())
    assert (store.gate.active, store.commits) == ("w-1", [])
