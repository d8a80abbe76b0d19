"""A monitor whose recoveries end by errors, for tests of what happens to them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import aiohttp

from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.cluster_objects import ClusterObjects, policy_of
from tests.unit.monitor.senses import GivenSenses, NoOutputs
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.failover.availability import Availability
from understudy.failover.dependency import UpstreamState
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.journal import Journal
from understudy.failover.progress import PodIdentity, Progress, beside
from understudy.failover.strategies.base import Choice, Strategy, StrategyContext
from understudy.kube.client import ApiError, Object
from understudy.kube.gates.base import GateRecord
from understudy.monitor.act.recovery.abandonment import Abandonment
from understudy.monitor.act.recovery.pool_waiting import PoolQueue
from understudy.monitor.act.recovery.recovery_journal import RecoveryJournal
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.observe.objects import interrupted_recovery
from understudy.monitor.observe.objects.storm_condition import StormCondition

FAILED = Instance(name="w-1", uid="u1")
STANDBY = Instance(name="w-2", uid="u2")
THIRD = Instance(name="w-3", uid="u3")
DENIED = ApiError(403, "Forbidden", "no role allows it")
AWAY = aiohttp.ClientConnectionError("refused")

Steps = Sequence[Instance | Exception | None]


class Does(Strategy):
    """Commits, for these instances or for none, and fails by what comes among them."""

    name = "Restart"

    def __init__(self, steps: Steps) -> None:
        self._steps = steps

    def availability(self, context: StrategyContext, progress: Progress | None = None) -> Availability:
        return Availability(True)

    async def prepare(self, progress: Progress, context: StrategyContext, *, within: float) -> Instance:
        for step in self._steps:
            if isinstance(step, Exception):
                raise step
            await context.gate.commit(step, progress)
        raise AssertionError("it ends by an error")


class Options(StrategyOptions):
    """One strategy that is always the same."""

    def __init__(self, objects: ClusterObjects, context: StrategyContext, strategy: Strategy) -> None:
        super().__init__(objects.view, StormCondition(objects.view), context)
        self._only = strategy

    def choices(self) -> Sequence[Choice]:
        return [Choice(self._only, 5.0)]


class Monitor:
    """What one monitor has for its recoveries: objects as it sees them, and a folder that outlasts it."""

    def __init__(self, client: MemoryClient, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self.client, self.folder = client, folder
        self.objects = ClusterObjects(folder, client=client)
        self.view, self.gate, self.notices = self.objects.view, self.objects.gate, self.objects.notices
        self.objects.put_settings()
        self.senses = GivenSenses(self.objects)
        self.journal = Journal(folder / "recovery.json")
        self.recoveries: list[Recovery] = []
        journal = RecoveryJournal(self.journal, self.objects.crash_points)
        self.abandonment = Abandonment(self.gate, journal, self.notices)
        self.ended: list[str] = []

    async def recover(self, *steps: Instance | Exception | None, progress: Progress | None = None) -> Progress:
        """Carry a recovery out, which an error ends."""
        recovery = progress or started_recovery()
        options = Options(self.objects, self._context(), Does(steps))
        state_manager, current = self.senses.state_manager, self.senses.current
        recoveries = RecoveryRunner(self.view, options, state_manager, current, self.abandonment, self.notices)
        self.ended.append((await recoveries.carry_out(recovery, policy_of())).kind)
        return recovery

    def _context(self) -> StrategyContext:
        return StrategyContext(
            gate=self.gate,
            instances=self.objects.pods,
            agents=self.senses.agents,
            outputs=NoOutputs(),
            queue=PoolQueue(self.view, self.notices),
            clock=lambda: 2.0,
            save=self.journal.save,
            workload_uid="uid-w",
        )

    async def look(self) -> None:
        """As in the housekeeping, and wait for what that has begun."""
        self.abandonment.update()
        for _ in range(10):
            await asyncio.sleep(0)

    def interrupted(self) -> Progress | None:
        """What a monitor that starts now would continue."""
        return interrupted_recovery.interrupted(self.journal, self.gate, self.notices.status, self.abandonment.ids)

    def upstream_state(self) -> UpstreamState:
        """What those that depend on it make of its gate and of its status, once that says that it is well."""
        recovery = beside(GateRecord.of(self.policy).recovery)
        return UpstreamState.of(RobotWorkloadStatus(health="Healthy", recoveries=self.recoveries), recovery)

    @property
    def policy(self) -> Object:
        """The gate as the API server has it."""
        return self.client.items[self.view.gate_kind.resource.plural, "fleet", self.objects.gate_name]

    def fail(self, method: str, error: Exception | None) -> None:
        """Have every such request fail, or none any more."""
        self.client.failing = lambda asked, name: error if asked == method else None

    def watch(self) -> None:
        """The watch brings the gate as it is."""
        self.view.gates.put(self.policy)

    def successor(self, folder: Path) -> Monitor:
        """The next monitor of the same workload, which knows what the API server says and what is in a folder."""
        found = Monitor(self.client, folder)
        found.watch()
        return found


def monitor_of(client: MemoryClient, folder: Path) -> Monitor:
    """The first monitor of a workload, whose gate is open at epoch 4."""
    found = Monitor(client, folder)
    found.objects.put_gate(GateState(epoch=4, active=FAILED.name, active_uid=FAILED.uid))
    return found


def started_recovery(failed: Instance = FAILED) -> Progress:
    """A recovery that has begun."""
    pod = PodIdentity(name=failed.name, uid=failed.uid)
    return Progress.begin("it ended", last_healthy=1.0, detected=2.0, failed=[pod])


def written(client: MemoryClient) -> int:
    """How many patches were sent."""
    return sum(method == "PATCH" for method, _, _ in client.requests)
