"""A recovery in whose middle the system's clock is set takes as long as without that, and its record is right."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import pytest

from tests.support.clock import set_clock
from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.protocol.monitor_settings import PoolChoice
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import Progress
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
STANDBY = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True, pool="hot")
STEPS = pytest.mark.parametrize("step", [0.0, -60.0, 60.0])


class Robot:
    """A workload with a hot standby, whose active instance was silent for half a second. The clock of its monitor can be set."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch
        self._monitor = GivenMonitor(folder)
        self._objects = self._monitor.objects
        self._objects.put_workload()
        self._objects.put_policy(policy_of({"type": "Fallback", "poolRef": {"name": "hot"}, "verifyWithin": "3s"}))
        self._objects.put_settings(pools=[PoolChoice(name="hot", readiness="Executing").model_dump()])
        self._objects.put_pods(ACTIVE, STANDBY)
        self._objects.put_gate(GateState(epoch=4, active=ACTIVE.name, active_uid=ACTIVE.uid))

    def set_clock(self, step: float) -> None:
        """Set the clock, which the times of packets follow."""
        set_clock(self._monkeypatch, step)
        for uid, last in self._objects.packets.items():
            self._objects.packets[uid] = last + step

    def gets_through(self, instance: Instance) -> None:
        """A packet of an instance passes the gate now."""
        self._objects.packets[instance.uid] = time.time()

    def at_the_commit(self, then: Callable[[], None]) -> None:
        """Do something when the API server receives the commit."""

        def called(method: str, name: str) -> None:
            if method == "PATCH" and name == self._objects.gate_name:
                self._objects.client.failing = lambda method, name: None
                then()

        self._objects.client.failing = called

    async def recover(self) -> Recovery:
        now = time.time()
        failure = Failure("no /cmd_vel", now - 0.5, now, Trigger.HEALTH_FAILED)
        async with asyncio.timeout(10):
            await self._monitor.loop.carry_through(Resolution(Recover("HealthFailed"), failure))
        return self._monitor.notices.status.recoveries[0]

    @property
    def recorded_at_the_gate(self) -> Progress:
        found = self._objects.gate.state.recovery
        assert found is not None
        return found


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(tmp_path, monkeypatch)


def moment(recovery: Recovery, name: str) -> float:
    return datetime.fromisoformat(getattr(recovery.moments, name)).timestamp()


@STEPS
@pytest.mark.parametrize("after", [0.0, 0.03], ids=["at the commit", "while the others must be silent"])
async def test_a_clock_step_changes_neither_the_length_of_a_recovery_nor_its_record(
    robot: Robot, step: float, after: float
) -> None:
    def commit() -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(after, robot.set_clock, step)
        loop.call_later(0.02 if after else 0.001, robot.gets_through, STANDBY)

    robot.at_the_commit(commit)
    began = time.monotonic()
    done = await robot.recover()
    took = time.monotonic() - began
    assert took < 0.9
    assert (done.result, done.to_pod, [a.result for a in done.attempts]) == ("Recovered", "w-2", ["Verified"])
    assert done.recovery_seconds == pytest.approx(0.5, abs=0.9)
    moments = [moment(done, m) for m in ("last_healthy", "detected", "decided", "routed", "verified")]
    assert moments == sorted(moments)
    assert moments[-1] - moments[0] == pytest.approx(0.5 + took, abs=0.3)
    assert moments[-1] == pytest.approx(time.time(), abs=0.5), "by the clock as it is set at the end"


@STEPS
async def test_a_sign_of_life_after_a_clock_step_delays_the_end_of_a_recovery_by_its_silence(
    robot: Robot, step: float
) -> None:
    heard: list[float] = []

    def leak() -> None:
        robot.gets_through(ACTIVE)
        heard.append(time.monotonic())

    def commit() -> None:
        loop = asyncio.get_running_loop()
        robot.gets_through(STANDBY)
        loop.call_later(0.04, robot.set_clock, step)
        loop.call_later(0.08, leak)

    robot.at_the_commit(commit)
    done = await robot.recover()
    assert done.result == "Recovered"
    silence = time.monotonic() - heard[0]
    assert 0.1 <= silence < 0.9
    assert moment(done, "verified") - moment(done, "fenced") == pytest.approx(silence, abs=0.3)
