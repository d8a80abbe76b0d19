"""The record at the gate of a recovery that another monitor began and never recorded.

The monitor is the older one of two. The newer one has driven the robot to its end and is gone, and its record was written over.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import aiohttp
import pytest

from tests.support.clock import Clock
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.abandoned_recoveries import STANDBY, THIRD, Monitor, monitor_of, started_recovery, written
from understudy.failover.interfaces import Instance, Superseded
from understudy.failover.progress import LASTS, PodIdentity, beside
from understudy.kube.gates.base import GateRecord
from understudy.monitor.act.recovery import abandonment


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock(100.0)
    monkeypatch.setattr(abandonment, "time", clock)
    return clock


@pytest.fixture
def monitor(tmp_path: Path) -> Monitor:
    return monitor_of(MemoryClient(), tmp_path)


@pytest.fixture
async def later(monitor: Monitor, tmp_path: Path) -> Monitor:
    await monitor.gate.commit(STANDBY, started_recovery())
    found = monitor.successor(tmp_path / "elsewhere")
    found.notices.set(health="Healthy")
    return found


async def test_a_recovery_of_another_monitor_ends_after_the_robot_was_driven_long_enough(
    later: Monitor, clock: Clock
) -> None:
    for now in (100.0, 100.0 + LASTS - 0.1):
        clock.now = now
        await later.look()
        assert later.upstream_state().failing
    clock.now = 100.0 + LASTS
    await later.look()
    assert not later.upstream_state().failing
    assert GateRecord.of(later.policy).active == STANDBY.name


@pytest.mark.parametrize("health", ["Failed", "Starting", "Unknown", "Recovering"])
async def test_a_recovery_of_another_monitor_does_not_end_while_the_robot_is_not_driven(
    later: Monitor, clock: Clock, health: str
) -> None:
    for clock.now in (100.0, 200.0, 300.0):
        later.notices.set(health="Healthy" if clock.now == 100.0 else health)
        await later.look()
    later.notices.set(health="Healthy")
    await later.look()
    assert later.upstream_state().failing, "it counts from when it is healthy again"


async def test_each_commit_restarts_the_time(monitor: Monitor, later: Monitor, clock: Clock) -> None:
    await later.look()
    clock.now += LASTS - 1
    await monitor.gate.commit(THIRD, started_recovery(STANDBY))
    later.watch()
    await later.look()
    clock.now += LASTS - 1
    await later.look()
    assert later.upstream_state().failing


async def test_a_recovery_in_the_status_is_not_changed(later: Monitor, clock: Clock) -> None:
    found = beside(GateRecord.of(later.policy).recovery)
    assert found is not None
    later.notices.record(found.model_copy(update={"result": "Recovered"}))
    before = written(later.client)
    for clock.now in (100.0, 200.0, 300.0):
        await later.look()
    assert written(later.client) == before


async def test_a_switchover_of_another_monitor_is_not_ended(monitor: Monitor, later: Monitor, clock: Clock) -> None:
    switchover = started_recovery(STANDBY).model_copy(update={"switchover": "Failover", "planned": True})
    await monitor.gate.commit(THIRD, switchover)
    later.watch()
    for clock.now in (100.0, 200.0, 300.0):
        await later.look()
    found = beside(GateRecord.of(later.policy).recovery)
    assert found is not None
    assert found.result == "Running"


async def test_a_monitor_commits_nothing_to_a_recovery_that_another_one_has_taken_over(
    monitor: Monitor, tmp_path: Path
) -> None:
    progress = started_recovery().model_copy(update={"monitor": PodIdentity(name="m-1", uid="uid-m1")})
    await monitor.gate.commit(None, progress)
    other = monitor.successor(tmp_path / "elsewhere")
    mine = progress.model_copy(update={"monitor": PodIdentity(name="m-2", uid="uid-m2")})
    assert await other.gate.take_over(mine)
    with pytest.raises(Superseded):
        await monitor.gate.commit(STANDBY, progress)
    await other.gate.commit(STANDBY, mine)
    assert GateRecord.of(other.policy).active == STANDBY.name


@pytest.mark.parametrize("opened_for", [None, STANDBY])
async def test_a_commit_of_a_former_process_that_the_api_server_carried_out_late_counts_as_own(
    monitor: Monitor, tmp_path: Path, opened_for: Instance | None
) -> None:
    me = PodIdentity(name="m-1", uid="uid-m1")
    progress = started_recovery().model_copy(update={"monitor": me})
    successor = monitor.successor(tmp_path / "elsewhere")  # the next process of the pod
    again = progress.model_copy(update={"cursor": progress.cursor + 1.0})
    successor.client.failing = lambda method, name: aiohttp.ClientConnectionError("unreachable")
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(0.05):
            await successor.gate.commit(None, again)
    successor.client.failing = lambda method, name: None
    await monitor.gate.commit(opened_for, progress)
    successor.watch()
    assert await successor.gate.take_over(again)
    await successor.gate.commit(THIRD, again)
    assert GateRecord.of(successor.policy).active == THIRD.name


async def test_a_recovery_for_which_the_gate_is_open_is_not_taken_over(later: Monitor, monitor: Monitor) -> None:
    found = beside(GateRecord.of(later.policy).recovery)
    assert found is not None
    before = written(later.client)
    assert await later.gate.take_over(found.model_copy(update={"monitor": PodIdentity(name="m-2", uid="uid-m2")}))
    assert written(later.client) == before
