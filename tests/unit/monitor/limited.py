"""A monitor's loop whose workload has a budget, for tests."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support.notices import RecordedNotices
from tests.unit.monitor.blank_parts import blank_parts
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.decide import Hold, Recover
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.monitor.act.recovery import deferred_recovery as holding
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner
from understudy.monitor.act.stage import ActStage
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.loop import MonitorLoop

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)


class Gate:
    """Closes and opens."""

    exists = True

    def __init__(self) -> None:
        self.state = GateState(epoch=3, active="w-1", active_uid="uid-1")
        self.committed: list[tuple[Instance | None, Progress]] = []
        self.refuses: Exception | None = None

    def left_by(self, recovery: str) -> None:
        return

    async def commit(self, target: Instance | None, progress: Progress) -> GateState:
        if self.refuses is not None:
            raise self.refuses
        self.committed.append((target, progress.model_copy(deep=True)))
        self.state = GateState(epoch=self.state.epoch + 1, recovery=progress)
        return self.state


class World:
    """A supervisor of a workload whose policy has a budget of one recovery in ten minutes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **limits: Any) -> None:
        monkeypatch.setattr(holding, "LOOK", 0.01)
        spec = {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
            "strategies": [{"type": "Restart"}, {"type": "Restart"}],
            "limits": {"budget": {"recoveries": 1, "within": "10m"}} | limits,
        }
        self.told, self.gate, self.kept = RecordedNotices(), Gate(), cast("list[Progress]", [])
        self.item: dict[str, Any] = {"metadata": {"name": "w"}}
        self.spec = SimpleNamespace(pause=None)
        self.view = SimpleNamespace(
            policy=FailurePolicySpec.model_validate(spec),
            settings=SimpleNamespace(uid="uid-w"),
            spec=self.spec,
            object=self.item,
            retired=False,
            namespace="fleet",
            workload="w",
        )
        journal = SimpleNamespace(
            save=lambda progress: self.kept.append(progress.model_copy(deep=True)), clear=lambda: None
        )
        pods = SimpleNamespace(of_workload=lambda: [ACTIVE])
        self.parts = blank_parts(view=self.view, pods=pods, gate=self.gate, notices=self.told, journal=journal)
        self.watching = MonitorLoop(self.parts)
        monkeypatch.setattr(MonitorLoop, "_housekeeping", lambda self: None)
        monkeypatch.setattr(ActStage, "get_ready", lambda self, policy: None)
        monkeypatch.setattr(ActStage, "follow_safety", lambda self, policy: None)
        monkeypatch.setattr(RecoveryRunner, "carry_out", self._carry_out)
        self.carried_out: list[Progress] = []

    async def _carry_out(self, progress: Progress, policy: FailurePolicySpec) -> None:
        self.carried_out.append(progress)

    def recovered(self, failure: Failure, now: float) -> Failure | None:
        """What is recovered of this failure at a time, if the limits allow it."""
        found = self.watching.decide.decide(self.view.policy, Judgement(now, failure=failure), None)
        return found.failure if isinstance(found.decision, Recover | Hold) else None

    async def allowed(self, progress: Progress) -> bool:
        """Whether a recovery is carried out, in the end."""
        await self.watching.carry_out(progress)
        return progress in self.carried_out

    def spend(self) -> None:
        self.told.set_spent([time.time() - 60])

    def resume(self) -> None:
        self.item["metadata"]["annotations"] = {names.RESUMED: rfc3339(time.time())}

    async def until(self, check: Callable[[], Any]) -> None:
        async with asyncio.timeout(5):
            while not check():
                await asyncio.sleep(0.005)


def failure(**more: Any) -> Progress:
    now = time.time()
    failed = [PodIdentity(name="w-1", uid="uid-1")]
    return Progress.begin("no /cmd_vel", last_healthy=now - 0.5, detected=now, failed=failed, **more)
