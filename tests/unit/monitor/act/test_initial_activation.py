"""While no pod is in control and none is being recovered, the gate is opened for one that runs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tests.unit.monitor.blank_parts import blank_parts
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.pause_spec import Pause
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import ApiError
from understudy.monitor.act.gate.gate_opening import ASK_AGAIN
from understudy.monitor.loop import MonitorLoop

ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True)
POLICY = FailurePolicySpec.model_validate(
    {
        "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
        "strategies": [{"type": "Restart"}],
    }
)


class Asked:
    """Instances of a workload of which none runs."""

    def __init__(self, *instances: Instance) -> None:
        self.instances, self.asked, self.away = instances, 0, False

    def of_workload(self) -> Any:
        return self.instances

    async def replace(self, failed: Any) -> None:
        self.asked += 1
        if self.away:
            raise ApiError(503, "Unavailable", "try again")


class ClosedGate:
    """Is opened once, or never."""

    exists = True

    def __init__(self, left: Progress | None = None) -> None:
        self.state = GateState(epoch=4, recovery=left)
        self.committed: list[tuple[Instance, Progress | None]] = []

    async def commit(self, target: Instance, progress: Progress | None) -> None:
        self.committed.append((target, progress))


class Closed:
    """The loop of a monitor whose gate is closed."""

    def __init__(self, fleet: Asked, gate: ClosedGate, paused: Pause | None = None) -> None:
        spec = SimpleNamespace(pause=paused, failure_policy_ref=None)
        view = SimpleNamespace(policy=POLICY, settings=None, spec=spec, object=None, namespace="n", workload="w")
        agents = SimpleNamespace(is_ready=lambda _: (True, ""))
        self._gate = gate
        self._loop = MonitorLoop(blank_parts(view=view, pods=fleet, gate=gate, agents=agents))

    async def look(self, now: float) -> bool:
        """Look once; whether the gate was opened."""
        before = len(self._gate.committed)
        self._loop.decide.limits.pauses.look(now)
        await self._loop.look(POLICY, now)
        return len(self._gate.committed) > before


@pytest.mark.parametrize("left", [(), (replace(ACTIVE, terminating=True),), (replace(ACTIVE, running=False),)])
async def test_where_nothing_runs_and_nothing_is_recovered_a_pod_is_asked_for(left: tuple[Instance, ...]) -> None:
    # The operator may have scaled the workload's own ReplicaSet to none, for a pod of a shared pool that drove then.
    fleet = Asked(*left)
    first = Closed(fleet, ClosedGate())
    assert not await first.look(1000.0)
    assert fleet.asked == 1
    await first.look(1000.1)
    assert fleet.asked == 1, "not with every look"
    fleet.away = True
    await first.look(1000.0 + ASK_AGAIN)
    await first.look(1000.0 + 2 * ASK_AGAIN)
    assert fleet.asked == 3, "again and again, until one comes"
    await first.look(1000.0 - 3600)
    assert fleet.asked == 4, "also after the clock was set back"


async def test_a_gate_that_is_opened_after_a_recovery_came_to_nothing_still_tells_which_pods_had_failed() -> None:
    failed = [PodIdentity(name="w-0", uid="uid-0"), PodIdentity(name="w-1", uid="uid-1")]
    left = Progress.begin("it ended", last_healthy=0.0, detected=0.0, failed=failed)
    gate = ClosedGate(left)
    assert await Closed(Asked(ACTIVE), gate).look(1000.0)
    ((target, progress),) = gate.committed
    assert target.name == "w-1"
    assert progress is not None
    assert ([pod.name for pod in progress.failed], progress.result) == (["w-0"], "Failed"), "nobody goes on with it"


async def test_in_a_pause_nobody_is_put_in_control() -> None:
    gate = ClosedGate()
    assert not await Closed(Asked(ACTIVE), gate, Pause(reason="a new gripper", owner="ann")).look(1000.0)
    assert gate.committed == []
