"""While another monitor recovers the workload, this one opens no gate; if the other one stopped, this one finishes its recovery."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.support.clock import Clock
from tests.unit.monitor.cluster_objects import MONITOR, NAMESPACE, gate_object, policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.decide import Decision, Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import LASTS, PodIdentity, Progress
from understudy.kube.client import PODS, ApiError, Object
from understudy.monitor.decide import recovery_of_another
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.observe.objects import other_monitors
from understudy.monitor.observe.objects.other_monitors import ASK_PERIOD

RUNNING = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
POLICY = policy_of({"type": "Restart", "verifyWithin": "30s"})
FOREIGN = Progress.begin(
    "no /cmd_vel", last_healthy=99.0, detected=99.5, failed=[PodIdentity(name="w-0", uid="uid-0")]
).model_copy(update={"epoch": 4})
OTHER = PodIdentity(name="w-monitor-0", uid="uid-m0")
THIRD = PodIdentity(name="w-monitor-2", uid="uid-m2")
NAMED = FOREIGN.model_copy(update={"monitor": OTHER})


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock(100.0)
    monkeypatch.setattr(recovery_of_another, "time", clock)
    monkeypatch.setattr(other_monitors, "time", clock)
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

    def put_monitor(self, pod: PodIdentity, *, deleted: bool = False) -> None:
        """Have the pod of a monitor."""
        metadata: Object = {"name": pod.name, "uid": pod.uid}
        metadata |= {"deletionTimestamp": "2026-01-01T00:00:30Z"} if deleted else {}
        self.objects.client.store(PODS, NAMESPACE, {"metadata": metadata})

    async def look(self) -> Decision:
        self.loop.decide.limits.pauses.update(1000.0)
        return (await self.loop.evaluate(POLICY, 1000.0)).decision

    async def look_twice(self) -> Decision:
        """Look again after the API server's answer to a question that the first look asked."""
        await self.look()
        for _ in range(5):
            await asyncio.sleep(0)
        return await self.look()

    @property
    def questions(self) -> list[str]:
        """The objects that the API server was asked for, one by one."""
        return [name for method, name, _ in self.objects.client.requests if method == "GET"]

    async def carry_on(self, decision: Decision) -> None:
        """Carry out what was decided for a while: the agent of the instance never answers here."""
        carrying = asyncio.create_task(self.loop.carry_through(Resolution(decision)))
        for _ in range(100):
            await asyncio.sleep(0)
        carrying.cancel()
        await asyncio.gather(carrying, return_exceptions=True)


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
    await beside.carry_on(decision)
    assert {target for target, _ in beside.objects.commits} == {""}, (
        "it opens by the recovery, once the instance is ready"
    )
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


# -- the pod of the other monitor -----------------------------------------------------------------------------------


async def test_a_recovery_is_continued_at_once_if_the_pod_of_its_monitor_is_gone(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=NAMED)
    decision = await beside.look_twice()
    assert isinstance(decision, Recover)
    assert decision.trigger is Trigger.INTERRUPTED_RECOVERY


async def test_a_recovery_is_continued_at_once_if_another_pod_has_the_name_of_its_monitor(
    tmp_path: Path, clock: Clock
) -> None:
    beside = Beside(tmp_path, left=NAMED)
    beside.put_monitor(PodIdentity(name=OTHER.name, uid="uid-later"))
    assert isinstance(await beside.look_twice(), Recover)


@pytest.mark.parametrize("deleted", [False, True])
async def test_a_monitor_whose_pod_exists_counts_as_living(tmp_path: Path, clock: Clock, deleted: bool) -> None:
    beside = Beside(tmp_path, left=NAMED)
    beside.put_monitor(OTHER, deleted=deleted)
    for clock.now in (100.0, 110.0, 100.0 + 30.0 + LASTS - 0.1):
        assert (await beside.look_twice()).reason == "RecoveryUnderWay"
    assert beside.objects.commits == []


@pytest.mark.parametrize(
    "error", [ApiError(403, "Forbidden", "no role allows it"), ApiError(503, "Busy", "later"), TimeoutError()]
)
async def test_a_monitor_counts_as_living_while_the_api_server_does_not_say_that_its_pod_is_gone(
    tmp_path: Path, clock: Clock, error: Exception
) -> None:
    beside = Beside(tmp_path, left=NAMED)
    beside.objects.client.failing = lambda method, name: error if name == OTHER.name else None
    for clock.now in (100.0, 110.0, 100.0 + 30.0 + LASTS - 0.1):
        assert (await beside.look_twice()).reason == "RecoveryUnderWay"


async def test_a_monitor_that_its_recovery_does_not_name_counts_as_living(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path)
    assert (await beside.look_twice()).reason == "RecoveryUnderWay"
    assert beside.questions == []


async def test_the_api_server_is_asked_for_the_pod_no_more_often_than_once_a_second(
    tmp_path: Path, clock: Clock
) -> None:
    beside = Beside(tmp_path, left=NAMED)
    beside.put_monitor(OTHER)
    for clock.now in (100.0, 100.1, 100.0 + ASK_PERIOD - 0.01):
        await beside.look_twice()
    assert beside.questions == [OTHER.name]
    clock.now = 100.0 + ASK_PERIOD
    await beside.look_twice()
    assert beside.questions == [OTHER.name] * 2


async def test_the_api_server_is_not_asked_once_the_recovery_has_ended(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=NAMED.model_copy(update={"result": "Failed"}))
    await beside.look_twice()
    assert beside.questions == []


async def test_a_recovery_that_names_this_monitor_is_continued_at_once(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=FOREIGN.model_copy(update={"monitor": MONITOR}))
    assert isinstance(await beside.look(), Recover)
    assert beside.questions == []


async def test_a_monitor_that_continues_a_recovery_names_itself_at_the_gate_first(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=NAMED)
    await beside.carry_on(await beside.look_twice())
    state = beside.objects.gate.state
    assert state.recovery is not None
    assert (state.epoch, state.closed, state.recovery.id, state.recovery.monitor) == (5, True, FOREIGN.id, MONITOR)


async def test_of_two_monitors_that_continue_a_recovery_one_carries_it_out(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=NAMED)
    beside.put_monitor(THIRD)
    decision = await beside.look_twice()
    taken = GateState(epoch=5, recovery=NAMED.model_copy(update={"epoch": 5, "monitor": THIRD}))
    kind = beside.objects.view.gate_kind
    beside.objects.client.store(kind.resource, NAMESPACE, gate_object(kind, "w", taken))  # no watch has reported it yet
    await beside.carry_on(decision)
    assert beside.objects.gate.state.epoch == 5
    assert (await beside.look_twice()).reason == "RecoveryUnderWay"


async def test_a_recovery_that_was_taken_from_this_monitor_can_return_to_it(tmp_path: Path, clock: Clock) -> None:
    beside = Beside(tmp_path, left=NAMED)
    await beside.carry_on(await beside.look_twice())
    taken = NAMED.model_copy(update={"epoch": 6, "monitor": THIRD})
    beside.objects.put_gate(GateState(epoch=6, recovery=taken))
    clock.now += ASK_PERIOD
    await beside.carry_on(await beside.look_twice())
    state = beside.objects.gate.state
    assert state.recovery is not None
    assert (state.epoch, state.recovery.monitor) == (7, MONITOR)
