"""What the failover protocol needs: the gate, the instances, their agents and their outputs.

The monitor implements it with DDS and the Kubernetes API; tests need neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Protocol

from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.failover.bring_up import BringUp
from understudy.failover.progress import Progress
from understudy.trees.core.observations import PodCondition


class NotAvailable(Exception):
    """The resources of a strategy are missing, for example because its pool has no ready pod. Nothing was changed."""


class ClaimsLost(NotAvailable):
    """Other workloads claimed every free pod first. Another attempt may succeed."""


class NotVerified(Exception):
    """A strategy was carried out, but outputs of the new instance did not reach the robot."""


class Superseded(Exception):
    """Another writer committed to the gate at a newer epoch: an action at an older epoch must stop."""


class ClaimLost(Exception):
    """Another workload's claim on the pod was first."""


@dataclass(frozen=True)
class Instance:
    """One pod that runs, or could run, the workload's application."""

    name: str
    uid: str
    ip: str = ""
    pool: str = ""
    """The FallbackPool that created it; empty for pods of the workload's own controller."""
    running: bool = False
    ready: bool = False
    held: bool = False
    terminating: bool = False
    node: str = ""
    """The node where it runs."""
    has_agent: bool = True
    claim: str = ""
    template_hash: str = ""
    created: str = ""
    restarts: int = 0
    """How often its containers were restarted. What was done to their processes is lost then."""
    crashing: bool = False
    """Whether one of its containers is in CrashLoopBackOff."""
    evicted: bool = False
    """Whether it is being deleted because its node is unreachable. Its processes cannot be ended."""
    conditions: tuple[PodCondition, ...] = field(default=(), compare=False)
    """What its status says."""

    @property
    def from_source(self) -> bool:
        """Whether the workload's own controller created it, and replaces it if it is deleted."""
        return not self.pool

    @property
    def usable(self) -> bool:
        """Whether it could drive the robot now or soon."""
        return self.running and not self.terminating

    @property
    def leaving(self) -> bool:
        """Whether its processes are being ended."""
        return self.terminating and not self.evicted


@dataclass(frozen=True)
class GateState:
    """Who may reach the robot, as last committed."""

    epoch: int = 0
    active: str = ""
    active_uid: str = ""
    recovery: Progress | None = field(default=None, compare=False)
    """The recovery that committed last, if one did."""
    admitted: str = ""
    """A standby that may reach the robot too: the robot's readers follow it if the active pod is silent (the reflex)."""
    admitted_uid: str = ""

    @property
    def closed(self) -> bool:
        """Whether no pod may reach the robot."""
        return not self.active


class Gate(Protocol):
    """The commit point."""

    @property
    def exists(self) -> bool:
        """Whether it is there: the operator has created it, and nobody has deleted it."""

    @property
    def state(self) -> GateState:
        """Its state as last seen or committed."""

    async def commit(self, target: Instance | None, progress: Progress | None) -> GateState:
        """Open it for one instance, or close it: one atomic write at the next epoch. Retries while the API is away.

        Raises Superseded.
        """

    async def enforced(self, target: Instance, *, since: float) -> float:
        """Wait until packets of the instance get through the gate; when they first did, in unix seconds."""

    def last_packet(self, uid: str) -> float | None:
        """When a packet of a pod last got through the gate, in unix seconds."""


class Instances(Protocol):
    """The workload's pods and the pools'."""

    def of_workload(self) -> Sequence[Instance]:
        """Every instance of this workload, terminating ones included."""

    def find(self, uid: str) -> Instance | None:
        """The instance of this workload with a UID."""

    async def refresh_unclaimed(self, pool: str, *, part: bool = False) -> None:
        """Request which pods of a shared pool are unclaimed. Waits while the API server is away.

        If some are enough, ``part`` requests those of one part of the pool. Other workloads request other parts.
        """

    def followed(self, pool: str) -> AbstractAsyncContextManager[None]:
        """Watch the unclaimed pods of a shared pool while the context is open."""

    def stocked(self, pool: str) -> bool:
        """Whether a shared pool has a pod that this workload could claim, by what is known without a request."""

    def unclaimed(self, pool: str) -> Sequence[Instance]:
        """Pods of a shared pool that are ready at its present template and belong to nobody, of those that were requested."""

    async def claim(self, instance: Instance, claim: str) -> Instance:
        """Make an unclaimed pod an instance of this workload. Raises ClaimLost."""

    async def retire(self, instance: Instance) -> None:
        """Delete a failed pod for good: its controller makes another only where that one is still needed."""

    async def replace(self, failed: Sequence[Instance]) -> None:
        """Delete failed pods and have the workload's own controller run a new one."""

    async def wait(self, predicate: Callable[[Instance], bool]) -> Instance:
        """The newest instance of this workload for which it holds, waiting for one."""


class Agents(Protocol):
    """The sidecars of the instances."""

    async def probe(self, instance: Instance, duration: float) -> None:
        """Have it send gate probes, a millisecond apart at first, for so many seconds; returns at once, and never fails."""

    async def give_way(self, instance: Instance) -> None:
        """Have its restarted processes not be heard by a robot with the reflex; returns at once, and never fails."""

    async def start(self, instance: Instance) -> None:
        """Start the held processes of a claimed instance with this robot's settings. Harmless when repeated."""

    async def up(self, instance: Instance) -> float:
        """Wait until its processes are up; when they were, in unix seconds."""

    async def ready(self, instance: Instance) -> float:
        """Wait until the health tree holds on its own outputs; when it first did, in unix seconds."""

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        """Run a procedure on the instance within so many seconds. ``state`` is for its leaves; the result reports what was restored.

        Raises NotVerified, which says at which leaf it failed and why.
        """

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        """Give it the state of the last healthy instance, in so many seconds. What can't be given is in the report."""

    def follow(self, instances: Sequence[Instance]) -> None:
        """Have a connection to each of these that has an agent, and to no other."""

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        """Whether it is what it should be now, and else why not: its health tree holds, or its readiness check does."""


class Outputs(Protocol):
    """What arrives at the gated readers, which is what the robot sees."""

    @property
    def expected(self) -> Sequence[str]:
        """Gated topics that the health tree watches and that count now: each must be seen from an instance in control."""

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        """Wait for a sample of each expected topic from the instance, received after a time; when the first came.

        None where nothing is expected, or no longer is.
        """

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        """When a sample of any other instance last got through, in unix seconds (0 if never), and from which pod."""
