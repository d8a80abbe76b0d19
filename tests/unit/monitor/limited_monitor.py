"""A monitor's loop whose workload has a budget, for tests."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.decide import Hold, Recover
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.monitor.act.recovery import deferred_recovery
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.judge.stage import Judgement
from understudy.monitor.outcome import Outcome

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
RESTART = {"type": "Restart"}


class World:
    """The monitor of a workload whose policy has a budget of one recovery in ten minutes. No recovery is really carried out."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        folder: Path,
        *strategies: dict[str, Any],
        journal: Journal | None = None,
        **limits: Any,
    ) -> None:
        monkeypatch.setattr(deferred_recovery, "CHECK_PERIOD", 0.01)
        monkeypatch.setattr(RecoveryRunner, "carry_out", self._carry_out)
        self.carried_out: list[Progress] = []
        limits = {"budget": {"recoveries": 1, "within": "10m"}} | limits
        self.policy = policy_of(*(strategies or (RESTART, RESTART)), limits=limits)
        self.monitor = GivenMonitor(folder, journal=journal)
        self.objects, self.notices, self.loop = self.monitor.objects, self.monitor.notices, self.monitor.loop
        self._pause: Pause | None = None
        self._annotations: dict[str, str] = {}
        self._put_workload()
        self.objects.put_policy(self.policy)
        self.objects.put_settings()
        self.objects.put_pods(ACTIVE)
        self.objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))

    async def _carry_out(self, progress: Progress, policy: FailurePolicySpec) -> Outcome | None:
        self.carried_out.append(progress)
        return None

    def _put_workload(self) -> None:
        pause = self._pause.to_wire() if self._pause is not None else None
        self.objects.put_workload(annotations=self._annotations, pause=pause)

    def recovered(self, failure: Failure, now: float) -> Failure | None:
        """What is recovered of this failure at a time, if the limits allow it."""
        found = self.loop.decide.decide(self.policy, Judgement(now, failure=failure), None)
        return found.failure if isinstance(found.decision, Recover | Hold) else None

    async def allowed(self, progress: Progress) -> bool:
        """Whether a recovery is carried out, in the end."""
        await self.loop.carry_out(progress)
        return progress in self.carried_out

    def spend(self) -> None:
        """Spend the budget."""
        self.notices.set_spent([time.time() - 60])

    def resume(self) -> None:
        """Give the budget back, as ``understudy resume`` does."""
        self._annotations = {names.RESUMED: rfc3339(time.time())}
        self._put_workload()

    def pause(self, pause: Pause | None) -> None:
        """Pause the workload, or end its pause."""
        self._pause = pause
        self._put_workload()

    async def until(self, check: Callable[[], Any]) -> None:
        """Wait until something holds."""
        async with asyncio.timeout(5):
            while not check():
                await asyncio.sleep(0.005)


def failure(**more: Any) -> Progress:
    """The recovery of a failure that was detected just now."""
    now = time.time()
    failed = [PodIdentity(name="w-1", uid="uid-1")]
    return Progress.begin("no /cmd_vel", last_healthy=now - 0.5, detected=now, failed=failed, **more)
