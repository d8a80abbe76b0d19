"""A monitor's senses for its robot and for its instances' agents, in place of DDS and connections.

Nothing fails or takes time except for the failures that the bench requests, because the subject is the API server and
the requests to it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Gate, Instance
from understudy.failover.pinned import PinnedPod
from understudy.kube.gates.base import Proof
from understudy.monitor.observe.robot.known_senders import Caller, KnownSender, OutputSender
from understudy.trees.core.health_tree import Verdict

STARTUP = 0.1
"""Seconds from the order to start a claimed instance until its outputs flow."""

LOOK = 0.02
"""Seconds between two checks during a wait."""


class Application:
    """The instances of one workload, with their health."""

    def __init__(self) -> None:
        self.healthy_since: dict[str, float] = {}
        """Start of health by UID, in unix seconds."""
        self.failed: dict[str, float] = {}
        """Time of the final failure, by UID."""

    def well(self, uid: str) -> bool:
        """Return whether the instance's outputs flow, through an open gate or into a closed one."""
        return self.healthy_since.get(uid, float("inf")) <= time.time() and uid not in self.failed

    def start(self, uid: str, after: float = 0.0) -> None:
        """Start the instance's processes."""
        self.healthy_since.setdefault(uid, time.time() + after)


class HealthObserver:
    """The data that arrives at the gated readers of one robot."""

    graph = None
    coming = None
    problems: Sequence[str] = ()
    waiting: Sequence[str] = ()
    summary = "Watching what reaches the robot."
    addresses: Mapping[str, str] = {}

    def __init__(self, application: Application) -> None:
        self._application = application
        self._uids: dict[str, str] = {}
        self._active = ""

    def follow(self, policy: Any, spec: Any) -> None:
        return

    def drain(self, instances: Sequence[Instance], active: str, pinned: Sequence[PinnedPod] = ()) -> None:
        self._uids = {i.name: i.uid for i in instances}
        self._active = self._uids.get(active, "")

    def last_from(self, pod: str) -> float | None:
        uid = self._uids.get(pod)
        if uid is None or uid not in self._application.healthy_since:
            return None
        return self._application.failed.get(uid, time.time())

    last_well = last_from

    def new_process(self, pod: str, *, since: float) -> bool:
        return self._application.healthy_since.get(self._uids.get(pod, ""), since) >= since

    def processes(self, pod: str) -> frozenset[bytes]:
        return frozenset()

    def discovered(self, instance: Instance) -> bool:
        return True

    hears_nobody = False

    def others_discovered(self, instance: Instance) -> bool:
        return True

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        return

    def known_senders(self) -> Sequence[KnownSender]:
        return ()

    def callers(self) -> Sequence[Caller]:
        return ()

    def output_senders(self) -> Sequence[OutputSender]:
        return ()

    def verdict(self, *, now: float, since: float) -> Verdict:
        if (failed := self._application.failed.get(self._active)) is not None:
            return Verdict("Failed", "no /cmd_vel for 0.5 s", "topic", failed)
        if not self._application.well(self._active):
            return Verdict("Starting", "not heard yet", "topic", None)
        return Verdict("Healthy", "", "", None)

    def deadline(self, *, now: float, since: float) -> float | None:
        return None

    def unreached(self, pod: str) -> str:
        return ""

    @property
    def drove_on_board(self) -> bool:
        return False

    def arrivals(self, topic: str, pod: str) -> Sequence[float]:
        return ()

    def ambiguous(self, pod: str) -> bool:
        return False

    def outputs(self, fleet: Any, gate: Gate) -> Outputs:
        return Outputs(self._application, gate)


class Outputs:
    """The failover protocol's view of the robot's data."""

    expected: Sequence[str] = ("/cmd_vel",)

    def __init__(self, application: Application, gate: Gate) -> None:
        self._application, self._gate = application, gate

    blind = False

    async def heard_held_back(self, instance: Instance) -> None:
        return

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        while self._gate.state.active_uid != instance.uid or not self._application.well(instance.uid):  # noqa: ASYNC110
            await asyncio.sleep(LOOK)
        return max(since, self._application.healthy_since[instance.uid])

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        return 0.0, ""

    def heard(self) -> Sequence[tuple[float, float]]:
        return []

    def switched_to(self, instance: Instance) -> str:
        return ""

    def period_of_others(self, instance: Instance) -> float:
        return 0.0


class Probes(Proof):
    """Reports every gate as enforced at once, because there is no network."""

    def __init__(self, application: Application) -> None:
        self._application = application
        self.gate: Gate | None = None

    async def wait(self, uid: str, after: float) -> float:
        return max(after, time.time())

    def last(self, uid: str) -> float | None:
        through = self.gate is not None and self.gate.state.active_uid == uid and self._application.well(uid)
        return time.time() if through else None


class AgentConnections:
    """The agents of a workload's instances. Instances of its own controller start by themselves, claimed ones are
    started by their agent."""

    newest_epoch = 0

    def __init__(self, application: Application) -> None:
        self._application = application

    def follow(self, instances: Sequence[Instance]) -> None:
        for instance in instances:
            if instance.running and not instance.held and not instance.claim:
                self._application.start(instance.uid)

    async def settle(self, instances: Sequence[Instance], within: float) -> None:
        self.follow(instances)

    def status(self, instance: Instance) -> AgentStatus | None:
        if not instance.running or instance.uid not in self._application.healthy_since:
            return None
        at, well = self._application.healthy_since[instance.uid], self._application.well(instance.uid)
        return AgentStatus(phase="Running", configured=True, ready=well, ready_at=at, process_up_at=at)

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        self.follow([instance])
        well = instance.running and self._application.well(instance.uid)
        return well, "" if well else "its outputs are not healthy"

    async def probe(self, instance: Instance, duration: float) -> None:
        return

    async def give_way(self, instance: Instance) -> None:
        return

    async def start(self, instance: Instance) -> None:
        self._application.start(instance.uid, STARTUP)

    async def up(self, instance: Instance) -> float:
        return await self.ready(instance)

    async def ready(self, instance: Instance) -> float:
        self.follow([instance])
        while not self._application.well(instance.uid):  # noqa: ASYNC110
            await asyncio.sleep(LOOK)
        return self._application.healthy_since[instance.uid]

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        return RestoreReport()

    async def run(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState, brought: str
    ) -> RestoreReport:
        return RestoreReport()

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        return RestoreReport()
