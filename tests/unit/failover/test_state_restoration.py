"""A recovery gives the instance that takes over the state of the last healthy one, and records the result."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from tests.unit.failover.world import Agents, Killed, Outputs, Store, World
from understudy.api.protocol.kept_state import (
    KeptSample,
    KeptState,
    NotRestored,
    ParameterValues,
    Restored,
    RestoreReport,
)
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.protocol import recover
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.uninitialized import UninitializedFallback

ONSET = -0.5


def store(**standby: object) -> Store:
    made = Store()
    made.add("w-1")
    made.broken.add("w-1")
    made.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
    made.kept = KeptState(
        (
            KeptSample(
                "/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ONSET - 1.25, b"pose", to="/initialpose"
            ),
            KeptSample("/map", "nav_msgs/msg/OccupancyGrid", ONSET - 9, b"map"),
        ),
        (ParameterValues("/controller", {"speed": 0.3}, ONSET - 2.0),),
        (),
        (NotRestored("/plan", "what is kept is 90.0 s old, more than maxAge (1m)", failed=False),),
    )
    if standby:
        made.add("w-2", **standby)
    return made


def failure(world: World) -> Progress:
    now = world.clock()
    failed = [PodIdentity(name="w-1", uid="uid-w-1")]
    progress = Progress.begin("no /cmd_vel for 500 ms", last_healthy=now - 0.5, detected=now, failed=failed)
    progress.moments["last_healthy"] = ONSET
    return progress


def recorded(progress: Progress) -> list[tuple[str, bool, float | None, str]]:
    return [(s.name, s.restored, s.age_seconds, s.message) for s in progress.to_recovery(1).state]


EXPECTED = [
    ("/amcl_pose", True, 1.25, ""),
    ("/controller (parameters)", True, 2.0, ""),
    ("/plan", False, None, "what is kept is 90.0 s old, more than maxAge (1m)"),
]


async def test_a_claimed_pod_receives_the_state_behind_the_closed_gate() -> None:
    made = store(pool="spare", held=True)
    done = await recover(failure(world := World(made)), [Choice(UninitializedFallback("spare"), 0.5)], world.context())
    assert done.result == "Recovered"
    assert made.kept_states == {"w-2": made.kept}
    assert recorded(done) == EXPECTED


async def test_commands_from_before_the_state_was_restored_expire_before_the_gate_opens() -> None:
    context = replace((world := World(store(pool="spare", held=True))).context(), expiry=0.2)
    done = await recover(failure(world), [Choice(UninitializedFallback("spare"), 1.0)], context)
    assert done.state[0].restored
    assert done.moments["committing"] - done.moments["started"] >= 0.2


async def test_a_pod_that_restarts_after_it_received_the_state_receives_it_again() -> None:
    made = store(pool="spare", held=True)
    made.restarts = 1
    done = await recover(failure(world := World(made)), [Choice(UninitializedFallback("spare"), 1.0)], world.context())
    assert (done.result, made.restored) == ("Recovered", 2)
    assert recorded(done) == EXPECTED


async def test_a_restarted_pod_receives_the_state() -> None:
    made = store()
    done = await recover(failure(world := World(made)), [Choice(Restart(), 0.5)], world.context())
    assert (done.result, list(made.kept_states)) == ("Recovered", ["w-new1"])
    assert recorded(done) == EXPECTED


async def test_an_executing_standby_receives_no_state() -> None:
    made = store(pool="hot")
    done = await recover(failure(world := World(made)), [Choice(ExecutingFallback("hot"), 0.5)], world.context())
    assert (done.result, made.kept_states, done.state) == ("Recovered", {}, [])


async def test_a_pod_without_an_agent_takes_over_and_is_recorded_without_restored_state() -> None:
    made = store()
    made.broken.discard("w-1")
    world = World(made)
    context = world.context()
    progress = failure(world)
    made.add("w-9", has_agent=False, created="9")
    made.pods.pop("w-1")
    done = await recover(progress, [Choice(Restart(), 0.5)], context)
    assert (done.result, made.kept_states) == ("Recovered", {})
    assert [(entry.name, entry.restored) for entry in done.state] == [
        ("/plan", False),
        ("/amcl_pose", False),
        ("/controller (parameters)", False),
    ]
    assert "pod w-9 has no agent" in done.state[1].message


async def test_a_failed_restoration_is_recorded_and_does_not_prevent_the_recovery() -> None:
    made = store()
    made.refusal = "nobody subscribes to /initialpose within 5 s"
    done = await recover(failure(world := World(made)), [Choice(Restart(), 0.5)], world.context())
    assert done.result == "Recovered"
    assert [(entry.name, entry.restored) for entry in done.to_recovery(1).state] == [
        ("/plan", False),
        ("/amcl_pose", False),
        ("/controller (parameters)", False),
    ]
    assert done.to_recovery(1).state[1].message == "nobody subscribes to /initialpose within 5 s"


class SlowOutputs(Outputs):
    """The first output of an instance arrives some time after the gate has opened."""

    async def first_from(self, instance: Instance, *, since: float) -> float:
        await asyncio.sleep(0.3)
        return await super().first_from(instance, since=since)


async def test_an_instance_that_restarts_after_the_gate_has_opened_does_not_take_over_without_its_state() -> None:
    made = store(pool="spare", held=True)
    world = World(made)
    context = replace(world.context(), outputs=SlowOutputs(world))
    choices = [Choice(UninitializedFallback("spare"), 1.0), Choice(Restart(), 1.0)]
    recovering = asyncio.create_task(recover(failure(world), choices, context))
    while made.gate.active != "w-2":
        await asyncio.sleep(0.01)
    made.pods["w-2"] = replace(made.pods["w-2"], restarts=1)
    done = await recovering
    assert (done.result, made.gate.active) == ("Recovered", "w-new1")
    assert done.attempts[0].message == "a container of pod w-2 restarted after it was given its state"


class Starting(Agents):
    """Instances that are not ready when they are given their state for the first time."""

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        return False, "no /cmd_vel yet"


@pytest.mark.parametrize(("was_ready", "restored"), [(False, 2), (True, 1)], ids=["only later", "all the time"])
async def test_an_instance_that_could_not_take_its_state_is_given_it_again_if_it_becomes_ready_later(
    was_ready: bool, restored: int
) -> None:
    made = store()
    made.refusal, made.refusals = "nobody subscribes to /initialpose within 5 s", 1
    world = World(made)
    context = replace(world.context(), restore_within=0.1, agents=Agents(world) if was_ready else Starting(world))
    done = await recover(failure(world), [Choice(Restart(), 1.0)], context)
    assert (done.result, made.restored) == ("Recovered", restored)
    assert all(entry.restored for entry in done.state if entry.name != "/plan") == (restored == 2)


async def test_state_that_was_never_kept_does_not_make_the_rest_be_given_again() -> None:
    made = store()
    context = replace((world := World(made)).context(), restore_within=0.1)
    done = await recover(failure(world), [Choice(Restart(), 1.0)], context)
    assert (recorded(done), made.restored) == (EXPECTED, 1)


class SlowSubscribers(Starting):
    """Instances that set their parameters, that nobody's samples reach, and that become ready some time later."""

    def __init__(self, world: World, *, takes: float = 0.02, restarts_at: int = 0, loses_agent_at: int = 0) -> None:
        """``takes`` is how long a restoration lasts, in seconds; the others say during which one something happens."""
        super().__init__(world)
        self._takes, self._restarts_at, self._loses_agent_at = takes, restarts_at, loses_agent_at

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        self.store.restored += 1
        await asyncio.sleep(self._takes)
        if self.store.restored == self._restarts_at:
            self.store.pods[instance.name] = replace(self.store.pods[instance.name], restarts=1)
        if self.store.restored == self._loses_agent_at:
            return state.none_restored("its agent is not connected")
        missing = (NotRestored(one.name, "nobody subscribes to it") for one in state.restored_samples)
        restored = tuple(Restored(one.name, one.taken_at) for one in state.parameters)
        return RestoreReport(restored, (*state.left_out, *missing))

    async def ready(self, instance: Instance) -> float:
        await asyncio.sleep(0.15)
        return self.world.clock()


async def given_to_slow_subscribers(
    *, within: float, expiry: float = 0.0, restore_within: float = 0.1, **slow: Any
) -> tuple[Progress, Store]:
    """The recovery, and the world after it."""
    world = World(made := store())
    context = replace(
        world.context(), restore_within=restore_within, expiry=expiry, agents=SlowSubscribers(world, **slow)
    )
    return await recover(failure(world), [Choice(Restart(), within)], context), made


async def test_a_recovery_with_time_for_everything_else_does_not_fail_because_state_is_given_again() -> None:
    done, made = await given_to_slow_subscribers(within=1.0, takes=0.4, restore_within=0.4, expiry=0.3)
    assert (done.result, made.restored) == ("Recovered", 1)


async def test_an_instance_that_restarts_while_it_is_given_state_again_receives_all_of_it_again() -> None:
    done, made = await given_to_slow_subscribers(within=2.0, restarts_at=2)
    assert done.result == "Recovered"
    assert made.restored > 2


async def test_what_was_restored_stays_restored_if_the_rest_is_given_again_in_vain() -> None:
    done, made = await given_to_slow_subscribers(within=2.0, loses_agent_at=2)
    assert (done.result, made.restored) == ("Recovered", 2)
    assert {entry.name: entry.restored for entry in done.state}["/controller (parameters)"]


async def test_state_is_not_given_again_if_no_time_is_left_to_open_the_gate() -> None:
    made = store()
    made.refusal = "nobody subscribes to /initialpose within 5 s"
    done = await recover(failure(world := World(made)), [Choice(Restart(), 1.0)], world.context())
    assert (done.result, made.restored) == ("Recovered", 1)


async def test_a_second_attempt_records_the_state_of_its_own_instance() -> None:
    made = store(pool="spare", held=True)
    made.broken.add("w-2")
    choices = [Choice(UninitializedFallback("spare"), 0.3), Choice(Restart(), 0.5)]
    done = await recover(failure(world := World(made)), choices, world.context())
    assert (done.result, list(made.kept_states)) == ("Recovered", ["w-2", "w-new1"])
    assert recorded(done) == EXPECTED


async def test_state_is_restored_although_the_monitor_is_killed_at_any_step() -> None:
    for step in range(60):
        made = store(pool="spare", held=True)
        world = World(made, dies_after=step)
        try:
            done = await recover(failure(world), [Choice(UninitializedFallback("spare"), 1.0)], world.context())
        except Killed:
            unfinished = made.journal or made.gate.recovery
            progress = unfinished.model_copy(deep=True) if unfinished is not None else failure(World(made))
            world = World(made)
            done = await recover(progress, [Choice(UninitializedFallback("spare"), 1.0)], world.context())
            assert (done.result, made.kept_states) == ("Recovered", {"w-2": made.kept}), f"killed at step {step}"
            assert recorded(done) == EXPECTED, f"killed at step {step}"
        else:
            assert step > 8
            return
    pytest.fail("the recovery never came to its end")
