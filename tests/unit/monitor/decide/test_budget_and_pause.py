"""The monitor's loop where it may not do what it could: a budget that is spent, a pause."""

from __future__ import annotations

import asyncio
import errno
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import pytest

from tests.unit.monitor.limited import ACTIVE, World, failure
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.decide import Recover
from understudy.failover.interfaces import GateState, Instance, Superseded
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import ApiError
from understudy.monitor import loop
from understudy.monitor.act.recovery.planned_switchover import PlannedSwitchovers
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.loop import MonitorLoop
from understudy.monitor.outcome import Outcome

PAUSE = Pause(reason="a new gripper", owner="ann")


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


async def test_within_the_budget_nothing_is_waited_for_nor_written(world: World) -> None:
    assert await world.allowed(failure())
    assert (world.gate.committed, world.kept, world.told.events) == ([], [], [])


async def test_once_it_is_spent_what_failed_is_fenced_and_the_robot_is_told_safe_commands_until_a_word(
    world: World,
) -> None:
    world.spend()
    progress = failure()
    holding = asyncio.create_task(world.allowed(progress))
    await world.until(lambda: ("Warning", "RecoveryHeld") in [event[:2] for event in world.told.events])
    ((target, committed),) = world.gate.committed
    assert target is None
    assert "held" in committed.moments, "the next monitor goes on holding it"
    assert "held" in world.kept[0].moments
    assert world.told.conditions["Recovering"][:2] == ("False", "BudgetSpent")
    assert world.told.status.health == "Failed"
    assert world.watching.act.unattended.since == progress.moments["fenced"]
    await asyncio.sleep(0.05)
    assert not holding.done()
    world.resume()
    async with asyncio.timeout(5):
        assert await holding
    assert progress.cursor == progress.moments["released"] > progress.moments["held"]
    assert ("Normal", "RecoveryReleased") in [event[:2] for event in world.told.events]
    assert world.parts.senses.current.progress is None


async def test_while_it_is_held_the_others_are_its_standbys_still_and_it_is_left_alone(world: World) -> None:
    world.spend()
    assert world.parts.senses.roles.driver == "uid-1"
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.told.events)
    assert world.gate.state.active_uid == ""
    assert world.parts.senses.roles.driver == "uid-1", "or a pod of its own controller would be brought up to drive"
    assert world.told.conditions["Healthy"] == ("False", "Failed", "no /cmd_vel")
    world.resume()
    async with asyncio.timeout(5):
        await holding
    assert world.parts.senses.roles.driver == ""


async def test_it_goes_on_by_itself_when_the_window_has_moved_on(world: World) -> None:
    world.told.set_spent([time.time() - 599.9])
    async with asyncio.timeout(5):
        assert await world.allowed(failure())
    assert len(world.gate.committed) == 1


async def test_an_interrupted_hold_is_gone_on_with_and_an_interrupted_recovery_is_finished(world: World) -> None:
    world.spend()
    begun = failure()
    begun.moments["decided"] = time.time()
    assert await world.allowed(begun)
    assert world.gate.committed == []
    held = failure()
    held.moments["held"] = held.moments["fenced"] = time.time() - 30
    world.gate.state = GateState(epoch=4, recovery=held)
    holding = asyncio.create_task(world.allowed(held))
    await world.until(lambda: world.told.events)
    assert world.gate.committed == [], "it is closed already"
    world.resume()
    async with asyncio.timeout(5):
        assert await holding
    assert held.moments["held"] < held.moments["released"] - 29


@pytest.mark.parametrize("exempt", ["planned", "reflex"])
async def test_what_is_no_new_failure_is_not_held(world: World, exempt: str) -> None:
    world.spend()
    progress = failure(planned=exempt == "planned")
    if exempt == "reflex":
        progress.taken_over = PodIdentity(name="w-2", uid="uid-2")
    assert await world.allowed(progress)


async def test_whoever_opens_the_gate_meanwhile_is_right(world: World) -> None:
    world.spend()
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.gate.committed)
    world.gate.state = GateState(epoch=9, active="w-3", active_uid="uid-3")
    async with asyncio.timeout(5):
        assert not await holding
    assert world.told.conditions["Recovering"][1] == "Superseded"


@pytest.mark.parametrize(
    ("error", "reason"), [(ApiError(403, "Forbidden", "no"), "Error"), (Superseded("another"), "Superseded")]
)
async def test_a_fence_that_fails_is_tried_again_as_another_recovery(
    world: World, tmp_path: Path, error: Exception, reason: str
) -> None:
    world.spend()
    world.gate.refuses = error
    world.parts.journal.journal = Journal(tmp_path / "recovery.json")
    assert not await world.allowed(failure())
    assert world.told.conditions["Recovering"][1] == reason
    assert world.parts.journal.journal.load() is None, "a new monitor would fence who may be well by then"


async def test_a_pause_ends_the_safe_commands_of_what_is_held_and_goes_before_the_budget(world: World) -> None:
    world.spend()
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.gate.committed)
    world.spec.pause = PAUSE
    await world.until(lambda: world.watching.decide.limits.pauses.on is not None)
    assert world.watching.act.unattended.since is None
    world.resume()
    await asyncio.sleep(0.05)
    assert not holding.done()
    world.spec.pause = None
    async with asyncio.timeout(5):
        assert await holding


def test_a_failure_in_a_pause_is_told_once_and_nothing_is_done(world: World) -> None:
    world.spec.pause = PAUSE
    now = time.time()
    world.watching.decide.limits.pauses.look(now)
    for _ in range(2):
        assert world.recovered(Failure("no /cmd_vel", now - 1, now), now) is None
    told = [message for kind, reason, message in world.told.events if reason == "RecoveryPostponed"]
    assert len(told) == 1
    assert PAUSE.words in told[0]
    assert world.told.status.health == "Failed"
    world.watching.act.unattended.conclude(Outcome("NothingVerified", failure()))
    assert world.watching.act.unattended.since is None, "no safe command: somebody may have hands on it"


def test_after_a_pause_a_failure_counts_from_its_end(world: World) -> None:
    world.spec.pause = PAUSE
    now = time.time()
    world.watching.decide.limits.pauses.look(now)
    world.spec.pause = None
    world.watching.decide.limits.pauses.look(now + 0.1)
    found = world.recovered(Failure("no /cmd_vel", now - 7200, now + 0.2), now + 0.2)
    assert found is not None
    assert found.onset == now
    found = world.recovered(Failure("no /cmd_vel", now + 50, now + 51), now + 51)
    assert found is not None
    assert found.onset == now + 50


async def test_a_volume_that_is_full_costs_no_recovery_and_leaves_nothing_old(world: World, tmp_path: Path) -> None:
    class Full(Journal):
        def save(self, progress: Progress) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    before = Journal(tmp_path / "recovery.json")
    before.save(failure())
    world.parts.journal.journal = Full(tmp_path / "recovery.json")
    world.spend()
    held = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.gate.committed)
    world.resume()
    assert await held, "it is fenced, and recovered once it may be"
    assert before.load() is None, "what is beside the gate is newer"


async def test_a_new_monitor_hears_of_the_understudies_before_it_chooses_and_an_older_one_knows(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a warm standby, to whose agent it has no connection yet, would be passed over for a restart."""
    heard: list[list[str]] = []

    async def settle(instances: Sequence[Instance], within: float) -> None:
        assert 0 < within <= loop.SETTLE
        assert not world.carried_out
        heard.append([instance.name for instance in instances])

    async def no_watch(self: MonitorLoop) -> None:
        raise asyncio.CancelledError

    standby = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True)
    watching, now = world.watching, time.time()
    lost = Resolution(Recover("HealthFailed"), Failure("no /cmd_vel", now - 0.5, now))
    agents, pods = cast(Any, world.parts.senses.agents), cast(Any, world.parts.cluster.pods)
    agents.settle, pods.of_workload = settle, lambda: [ACTIVE, standby]
    monkeypatch.setattr(MonitorLoop, "resume", no_watch)
    monkeypatch.setattr(PlannedSwitchovers, "failed", lambda self, reason: None)
    with pytest.raises(asyncio.CancelledError):
        await watching.run()
    await watching.carry_through(lost)
    assert (heard, len(world.carried_out)) == ([["w-2"]], 1)
    monkeypatch.setattr(loop, "SETTLE", 0.0)
    with pytest.raises(asyncio.CancelledError):
        await watching.run()
    await watching.carry_through(lost)
    assert (heard, len(world.carried_out)) == ([["w-2"]], 2)
