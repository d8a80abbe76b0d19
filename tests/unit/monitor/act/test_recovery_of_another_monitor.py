"""While another monitor recovers the workload, this one opens no gate; if the other one stopped, this one finishes its recovery."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import pytest

from tests.support.clock import Clock
from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.decide import Decision, Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import LASTS, PodIdentity, Progress
from understudy.monitor.decide import recovery_of_another
from understudy.monitor.decide.stage import Resolution

RUNNING = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
POLICY = policy_of({"type": "Restart", "verifyWithin": "30s"})
FOREIGN = Progress.begin(
    "no /cmd_vel", last_healthy=99.0, detected=99.5, failed=[PodIdentity(name="w-0", uid="uid-0")]
).model_copy(update={"epoch": 4})


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock(100.0)
    monkeypatch.setattr(recovery_of_another, "time", clock)
    return clock


class Beside:
    """A monitor beside another one, whose recovery has closed the gate."""

    def __init__(self, folder: Path, *, left: Progress = FOREIGN, paused: Pause | None = None) -> None:
        monitor = GivenMonitor(folder)
        self.objects, self.loop = monitor.objects, monitor.loop
        self.objects.put_workload(pause=paused.to_wire() if paused is not None else None)
        self.objects.put_policy(POLICY)
        self.objects.put_settings()
        self.objects.put_pods(RUNNING)
        self.objects.put_gate(GateState(epoch=4, recovery=left))

    async def look(self) -> Decision:
        self.loop.decide.limits.pauses.update(1000.0)
        return (await self.loop.evaluate(POLICY, 1000.0)).decision


async def test_the_gate_stays_closed_while_another_monitor_recovers(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path)
    for clock.now in (100.0, 110.0, 100.0 + 30.0 + LASTS - 0.1):
        assert (await beside.look()).reason == "RecoveryUnderWay"
    assert beside.objects.commits == []
    assert beside.objects.notices.status.health == "Recovering"


async def test_a_recovery_whose_monitor_stopped_is_finished_by_the_other_monitor(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path)
    await beside.look()
    clock.now += 30.0 + LASTS
    decision = await beside.look()
    assert isinstance(decision, Recover)
    assert decision.trigger is Trigger.INTERRUPTED_RECOVERY
    assert beside.objects.commits == [], "the gate opens by the recovery, once the instance is ready"
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(0.2):  # its agent never answers here
            await beside.loop.carry_through(Resolution(decision))
    assert beside.objects.notices.status.by_type["Recovering"].message == FOREIGN.reason


async def test_a_monitor_that_waits_for_a_pod_of_a_shared_pool_counts_as_living_for_that_time_too(
    tmp_path: Path, clock: Clock
) -> None:
    waiting = Waiter(workload="w", pool="spare", since=99.6, until=99.6 + 300.0)
    beside = Beside(tmp_path, left=FOREIGN.model_copy(update={"waiting": waiting}))
    for clock.now in (100.0, 100.0 + 30.0 + LASTS, 100.0 + 300.0 + 30.0 + LASTS - 0.1):
        assert (await beside.look()).reason == "RecoveryUnderWay"
    clock.now += 0.2
    assert isinstance(await beside.look(), Recover)


async def test_each_commit_of_the_other_monitor_shows_that_it_lives(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path)
    await beside.look()
    clock.now += 30.0 + LASTS - 1
    beside.objects.put_gate(GateState(epoch=5, recovery=FOREIGN.model_copy(update={"epoch": 5})))
    await beside.look()
    clock.now += 30.0 + LASTS - 1
    assert (await beside.look()).reason == "RecoveryUnderWay"


async def test_the_gate_opens_once_the_other_monitor_has_given_its_recovery_up(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path)
    await beside.look()
    beside.objects.put_gate(GateState(epoch=4, recovery=FOREIGN.model_copy(update={"result": "Failed"})))
    await beside.look()
    assert [target for target, _ in beside.objects.commits] == ["w-1"]


async def test_the_gate_opens_after_a_recovery_of_this_monitor_that_it_has_abandoned(
    tmp_path: Path, clock: Clock
) -> None:
    beside = Beside(tmp_path)
    beside.loop.act.abandonment.abandon(FOREIGN)
    await beside.look()
    assert [target for target, _ in beside.objects.commits] == ["w-1"]


async def test_an_interrupted_recovery_waits_for_the_end_of_a_pause(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, paused=Pause(reason="a new gripper", owner="ann"))
    await beside.look()
    clock.now += 1000.0
    assert (await beside.look()).reason == "Paused"
