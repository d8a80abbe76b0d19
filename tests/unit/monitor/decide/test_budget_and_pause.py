"""The monitor's loop where it may not do what it could: a budget that is spent, a pause."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.unit.monitor.limited_monitor import ACTIVE, World, failure
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.decide import Recover
from understudy.failover.interfaces import GateState, Instance, Superseded
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import ApiError
from understudy.monitor import loop
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.outcome import Outcome

PAUSE = Pause(reason="a new gripper", owner="ann")


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> World:
    return World(monkeypatch, tmp_path)


async def test_within_the_budget_nothing_is_held_or_written(world: World) -> None:
    assert await world.allowed(failure())
    assert (world.objects.commits, world.notices.events) == ([], [])
    assert world.monitor.journal.load() is None


async def test_with_a_spent_budget_the_failed_pod_is_fenced_and_safe_commands_are_sent(
    world: World,
) -> None:
    world.spend()
    progress = failure()
    holding = asyncio.create_task(world.allowed(progress))
    await world.until(lambda: ("Warning", "RecoveryHeld") in [event[:2] for event in world.notices.events])
    ((target, committed),) = world.objects.commits
    assert target == ""
    assert committed is not None
    assert "held" in committed.moments, "the next monitor goes on holding it"
    saved = world.monitor.journal.load()
    assert saved is not None
    assert "held" in saved.moments
    assert world.notices.conditions["Recovering"][:2] == ("False", "BudgetSpent")
    assert world.notices.status.health == "Failed"
    assert world.loop.act.unattended.since == progress.moments["fenced"]
    await asyncio.sleep(0.05)
    assert not holding.done()
    world.resume()
    async with asyncio.timeout(5):
        assert await holding
    assert progress.cursor == progress.moments["released"] > progress.moments["held"]
    assert ("Normal", "RecoveryReleased") in [event[:2] for event in world.notices.events]
    assert world.monitor.senses.current.progress is None


async def test_during_a_hold_the_failed_instance_keeps_its_role(world: World) -> None:
    world.spend()
    assert world.monitor.senses.roles.driver == "uid-1"
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.notices.events)
    assert world.objects.gate.state.active_uid == ""
    assert world.monitor.senses.roles.driver == "uid-1", "or a pod of its own controller would be brought up to drive"
    assert world.notices.conditions["Healthy"] == ("False", "Failed", "no /cmd_vel")
    world.resume()
    async with asyncio.timeout(5):
        await holding
    assert world.monitor.senses.roles.driver == ""


async def test_a_hold_ends_when_the_window_has_moved_on(world: World) -> None:
    world.notices.set_spent([time.time() - 599.9])
    async with asyncio.timeout(5):
        assert await world.allowed(failure())
    assert len(world.objects.commits) == 1


async def test_an_interrupted_hold_continues_and_an_interrupted_recovery_is_finished(world: World) -> None:
    world.spend()
    first_failure = failure()
    first_failure.moments["decided"] = time.time()
    assert await world.allowed(first_failure)
    assert world.objects.commits == []
    held = failure()
    held.moments["held"] = held.moments["fenced"] = time.time() - 30
    world.objects.put_gate(GateState(epoch=4, recovery=held))
    holding = asyncio.create_task(world.allowed(held))
    await world.until(lambda: world.notices.events)
    assert world.objects.commits == [], "it is closed already"
    world.resume()
    async with asyncio.timeout(5):
        assert await holding
    assert held.moments["held"] < held.moments["released"] - 29


@pytest.mark.parametrize("exempt", ["planned", "reflex"])
async def test_planned_recoveries_and_takeovers_by_the_reflex_are_not_held(world: World, exempt: str) -> None:
    world.spend()
    progress = failure(planned=exempt == "planned")
    if exempt == "reflex":
        progress.taken_over = PodIdentity(name="w-2", uid="uid-2")
    assert await world.allowed(progress)


async def test_a_gate_that_somebody_opens_during_a_hold_supersedes_the_recovery(world: World) -> None:
    world.spend()
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.objects.commits)
    world.objects.put_gate(GateState(epoch=9, active="w-3", active_uid="uid-3"))
    async with asyncio.timeout(5):
        assert not await holding
    assert world.notices.conditions["Recovering"][1] == "Superseded"


@pytest.mark.parametrize(
    ("error", "reason"), [(ApiError(403, "Forbidden", "no"), "Error"), (Superseded("another"), "Superseded")]
)
async def test_a_failed_fence_ends_the_recovery_without_a_journal(world: World, error: Exception, reason: str) -> None:
    world.spend()
    if isinstance(error, Superseded):
        world.objects.put_gate(GateState(epoch=4, active="w-9", active_uid="uid-9"))
    else:
        world.objects.client.failing = lambda method, name: error if method == "PATCH" else None
    assert not await world.allowed(failure())
    assert world.notices.conditions["Recovering"][1] == reason
    assert world.monitor.journal.load() is None, "a new monitor would fence who may be well by then"


async def test_a_pause_ends_safe_commands_of_a_held_recovery_and_takes_precedence_over_the_budget(world: World) -> None:
    world.spend()
    holding = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.objects.commits)
    world.pause(PAUSE)
    await world.until(lambda: world.loop.decide.limits.pauses.on is not None)
    assert world.loop.act.unattended.since is None
    world.resume()
    await asyncio.sleep(0.05)
    assert not holding.done()
    world.pause(None)
    async with asyncio.timeout(5):
        assert await holding


def test_a_failure_during_a_pause_is_reported_once_and_not_acted_on(world: World) -> None:
    world.pause(PAUSE)
    now = time.time()
    world.loop.decide.limits.pauses.update(now)
    for _ in range(2):
        assert world.recovered(Failure("no /cmd_vel", now - 1, now), now) is None
    messages = [message for kind, reason, message in world.notices.events if reason == "RecoveryPostponed"]
    assert len(messages) == 1
    assert PAUSE.words in messages[0]
    assert world.notices.status.health == "Failed"
    world.loop.act.unattended.conclude(Outcome("NothingVerified", failure()))
    assert world.loop.act.unattended.since is None, "no safe command: somebody may have hands on it"


def test_after_a_pause_a_failure_counts_from_its_end(world: World) -> None:
    world.pause(PAUSE)
    now = time.time()
    world.loop.decide.limits.pauses.update(now)
    world.pause(None)
    world.loop.decide.limits.pauses.update(now + 0.1)
    found = world.recovered(Failure("no /cmd_vel", now - 7200, now + 0.2), now + 0.2)
    assert found is not None
    assert found.onset == now
    found = world.recovered(Failure("no /cmd_vel", now + 50, now + 51), now + 51)
    assert found is not None
    assert found.onset == now + 50


async def test_a_full_volume_prevents_no_recovery_and_leaves_no_old_journal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Full(Journal):
        def save(self, progress: Progress) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    before = Journal(tmp_path / "recovery.json")
    before.save(failure())
    world = World(monkeypatch, tmp_path, journal=Full(tmp_path / "recovery.json"))
    world.spend()
    held = asyncio.create_task(world.allowed(failure()))
    await world.until(lambda: world.objects.commits)
    world.resume()
    assert await held, "it is fenced, and recovered once it may be"
    assert before.load() is None, "what is beside the gate is newer"


async def test_a_new_monitor_waits_for_the_agents_of_standbys_before_its_first_decision(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a warm standby, to whose agent it has no connection yet, would be passed over for a restart."""
    decisions: list[list[str]] = []

    async def settle(instances: Sequence[Instance], within: float) -> None:
        assert 0 < within <= loop.SETTLE
        assert not world.carried_out
        decisions.append([instance.name for instance in instances])

    async def start() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.05):
                await world.loop.run()

    now = time.time()
    lost = Resolution(Recover("HealthFailed"), Failure("no /cmd_vel", now - 0.5, now))
    monkeypatch.setattr(world.monitor.agents, "settle", settle)
    world.objects.put_pods(ACTIVE, Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True))
    await start()
    await world.loop.carry_through(lost)
    assert (decisions, len(world.carried_out)) == ([["w-2"]], 1)
    monkeypatch.setattr(loop, "SETTLE", 0.0)
    await start()
    await world.loop.carry_through(lost)
    assert (decisions, len(world.carried_out)) == ([["w-2"]], 2)
