"""When the status reports that a recovery is under way. A failover costs six API writes at most."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import NAMESPACE, policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api.protocol.monitor_settings import PoolChoice
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.kube.client import REPLICA_SETS, Object
from understudy.kube.events import Recorder
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.report import status_writer
from understudy.monitor.report.status_writer import StatusWriter

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True, has_agent=False)
NEXT = Instance(name="w-2", uid="uid-2", ip="10.0.0.2", running=True, ready=True, has_agent=False)
STANDBY = Instance(name="s-1", uid="uid-s", ip="10.0.0.3", running=True, ready=True, pool="hot")
RESTART: Object = {"type": "Restart"}
HOT: Object = {"type": "Fallback", "poolRef": {"name": "hot"}}


class Cluster:
    """A workload whose active instance failed, on an API server that counts what its monitor writes."""

    def __init__(self, folder: Path, *strategies: Object) -> None:
        self._monitor = GivenMonitor(folder)
        self._objects = self._monitor.objects
        self._objects.put_workload()
        self._objects.put_policy(policy_of(*strategies))
        self._objects.put_settings(pools=[PoolChoice(name="hot", readiness="Executing").model_dump()])
        self._objects.put_pods(ACTIVE, STANDBY)
        self._objects.put_gate(GateState(epoch=4, active=ACTIVE.name, active_uid=ACTIVE.uid))
        replica_set: Object = {"metadata": {"name": "w"}, "spec": {"replicas": 1}}
        self._objects.client.store(REPLICA_SETS, NAMESPACE, replica_set)
        self._monitor.notices.set(health="Healthy", active=ACTIVE.name)
        self.client: MemoryClient = self._objects.client
        self.client.request = self._apply  # type: ignore[method-assign]
        self.client.failing = self._called
        self.health: list[tuple[int, str]] = []
        """Each status that was written: after how many commits, and the health in it."""

    async def _apply(self, method: str, path: str, *, body: Any = None, **_: Any) -> Object:
        self.client.requests.append((method, "status", body))
        self.health.append((self._objects.gate.state.epoch - 4, body["status"]["health"]))
        return {"metadata": {"resourceVersion": "1000"}, "status": body["status"]}

    def _called(self, method: str, name: str) -> None:
        if method == "DELETE":  # the controller has another pod run
            loop = asyncio.get_running_loop()
            loop.call_soon(self._objects.put_pods, NEXT, STANDBY)
        if method == "PATCH" and name == self._objects.gate_name:
            self._objects.packets[STANDBY.uid] = time.time() + 0.01

    async def recover(self) -> None:
        """Recover, and wait until everything is written."""
        view, notices = self._monitor.view, self._monitor.notices
        writer = StatusWriter(self.client, view, Recorder(self.client, "understudy-monitor", "monitor"), notices)
        writing = asyncio.create_task(writer.run())
        await asyncio.sleep(0)
        now = time.time()
        failure = Failure("no /cmd_vel", now - 0.5, now, Trigger.HEALTH_FAILED)
        async with asyncio.timeout(10):
            await self._monitor.loop.carry_through(Resolution(Recover("HealthFailed"), failure))
            while self.health[-1:] == [] or self.health[-1][1] != "Healthy":
                await asyncio.sleep(0.005)
        await asyncio.sleep(0.1)
        writing.cancel()

    @property
    def writes(self) -> list[str]:
        return [f"{method} {name}" for method, name, _ in self.client.requests if method not in ("GET", "LIST")]


async def test_a_recovery_with_a_standby_is_in_the_status_once_the_standby_is_let_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_writer, "QUIET", 0.05)
    cluster = Cluster(tmp_path, HOT)
    await cluster.recover()
    assert cluster.health == [(1, "Recovering"), (1, "Healthy")], "the commit goes first"
    assert len(cluster.writes) <= 6, cluster.writes


async def test_a_short_recovery_by_a_restart_has_no_write_to_spare_for_its_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_writer, "QUIET", 0.05)
    cluster = Cluster(tmp_path, RESTART)
    await cluster.recover()
    assert cluster.health == [(2, "Healthy")]
    assert len(cluster.writes) == 6, cluster.writes
