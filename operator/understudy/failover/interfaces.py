"""The interfaces that the failover protocol needs: the gate, the instances, their agents and their outputs.

All times are of the process's clock (understudy.clock).

The monitor implements them with DDS and the Kubernetes API; tests need neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import Protocol

from understudy.api import names
from understudy.api.protocol.agent_messages import PROTOCOL
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.failover.bring_up import BringUp
from understudy.failover.pinned import PinnedPod
from understudy.failover.progress import Progress
from understudy.trees.core.observations import PodCondition


class NotAvailable(Exception):
    """The resources of a strategy are missing, for example because its pool has no ready pod. Nothing was changed."""


class ClaimsLost(NotAvailable):
    """Other workloads claimed every free pod first. Another attempt may succeed."""


class NotVerified(Exception):
    """A strategy was carried out, but outputs of the new instance did not reach the robot."""


class StillDriven(Exception):
    """An instance that the gate no longer lets through still reaches the robot, although its pod is being deleted."""


class Superseded(Exception):
    """Another writer committed to the gate at a newer epoch: an action at an older epoch must stop."""


class NoLongerNeeded(Exception):
    """The instance that a commit would fence is healthy: the one that failed, or one that took longer than its strategy's time."""


class ClaimLost(Exception):
    """Another workload's claim on the pod was first."""


@dataclass(frozen=True)
class Instance:
    """One pod that runs, or could run, the workload's application."""

    name: str
    uid: str
    ip: str = ""
    shares_address: bool = False
    """Whether it is in the network of its node, so that other processes there have its address too."""
    pool: str = ""
    """The FallbackPool that created it; empty for pods of the workload's own controller."""
    running: bool = False
    ready: bool = False
    held: bool = False
    terminating: bool = False
    node: str = ""
    """The node where it runs."""
    has_agent: bool = True
    agent_protocol: int = PROTOCOL
    """Version of the agents' protocol that its agent knows at least."""
    agent_port: int = names.AGENT_PORT
    """TCP port of its agent's control channel."""
    claim: str = ""
    template_hash: str = ""
    created: str = ""
    restarts: int = 0
    """How often its containers were restarted. A restart loses the state of their processes."""
    crashing: bool = False
    """Whether one of its containers is in CrashLoopBackOff."""
    evicted: bool = False
    """Whether it is being deleted because its node is unreachable. Its processes cannot be ended."""
    conditions: tuple[PodCondition, ...] = field(default=(), compare=False)
    """The conditions in its status."""
    owned: bool = False
    """Whether the RobotWorkload itself owns it, so that a pool made it, also if somebody has removed its labels."""

    @property
    def from_source(self) -> bool:
        """Whether the workload's own controller created it, and replaces it if it is deleted."""
        return not self.pool and not self.owned

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
    """The pods that may reach the robot, as last committed."""

    epoch: int = 0
    active: str = ""
    active_uid: str = ""
    recovery: Progress | None = field(default=None, compare=False)
    """The recovery that committed last, if one did."""
    admitted: str = ""
    """A standby that may reach the robot too: the robot's readers follow it if the active pod is silent (the reflex)."""
    admitted_uid: str = ""
    pinned: tuple[PinnedPod, ...] = field(default=(), compare=False)
    """The instances that the gate let through of late, newest first. They may still send although their pods are gone."""

    @property
    def closed(self) -> bool:
        """Whether no pod may reach the robot."""
        return not self.active


class Gate(Protocol):
    """The gate, whose atomic writes decide which instance drives the robot."""

    @property
    def exists(self) -> bool:
        """Whether the gate object exists."""

    @property
    def state(self) -> GateState:
        """The gate's state as last seen or committed."""

    async def commit(self, target: Instance | None, progress: Progress | None) -> GateState:
        """Open the gate for one instance, or close it (None), with one atomic write at the next epoch.

        Retries while the API server does not answer. Raises Superseded.
        """

    async def enforced(self, target: Instance, *, since: float) -> float:
        """Wait until packets of the instance pass the gate, and return when the first one did, in unix seconds."""

    @property
    def unanswered_since(self) -> float | None:
        """Since when (by the event loop's clock) the API server has not answered; None while it answers."""

    @property
    def last_outage(self) -> tuple[float, float] | None:
        """When (by the event loop's clock) the last outage of the API server began and ended, if the gate depends on others who watch the
        API server."""

    def last_packet(self, uid: str) -> float | None:
        """Return when a packet of a pod last passed the gate, in unix seconds."""


class Instances(Protocol):
    """The pods of the workload and of its pools."""

    def of_workload(self) -> Sequence[Instance]:
        """Return every instance of this workload, including terminating ones."""

    def find(self, uid: str) -> Instance | None:
        """Return the instance of this workload with a UID."""

    async def regain(self, name: str, uid: str) -> None:
        """Give a pod that is not listed its labels back, if it runs and belongs to this workload.

        Waits while the API server does not answer.
        """

    async def refresh_unclaimed(self, pool: str, *, part: bool = False) -> None:
        """Request which pods of a shared pool are unclaimed. Waits while the API server does not answer.

        Raises NotAvailable if it refuses.

        If a few pods are enough, ``part`` requests only one part of the pool. Other workloads request other parts.
        """

    def followed(self, pool: str) -> AbstractAsyncContextManager[None]:
        """Watch the unclaimed pods of a shared pool while the context is open."""

    def stocked(self, pool: str) -> bool:
        """Return whether a shared pool has a pod that this workload could claim, without a request."""

    def unclaimed(self, pool: str) -> Sequence[Instance]:
        """Return the requested pods of a shared pool that are unclaimed and ready at its present template."""

    async def claim(self, instance: Instance, claim: str) -> Instance:
        """Make an unclaimed pod an instance of this workload. Raises ClaimLost."""

    async def retire(self, instance: Instance) -> None:
        """Delete a failed pod. Its controller creates another one only if that is still needed."""

    async def end(self, instance: Instance) -> None:
        """Delete a pod that reaches the robot although it must not, with the shortest grace period, also if it is being deleted already."""

    async def replace(self, failed: Sequence[Instance]) -> None:
        """Delete failed pods and make the workload's own controller run a new one."""

    async def wait(self, predicate: Callable[[Instance], bool]) -> Instance:
        """Wait for an instance of this workload that satisfies the predicate, and return the newest one."""


class Agents(Protocol):
    """The agents, which are the sidecars of the instances."""

    async def probe(self, instance: Instance, duration: float) -> None:
        """Ask its agent to send gate probes for ``duration`` seconds, at first 1 ms apart. Returns at once; never fails."""

    async def give_way(self, instance: Instance) -> None:
        """Ask its agent to prevent a robot with the reflex from hearing restarted processes. Returns at once; never fails."""

    async def start(self, instance: Instance) -> None:
        """Start the held processes of a claimed instance with this robot's settings. Harmless when repeated."""

    async def up(self, instance: Instance) -> float:
        """Wait until its processes are up, and return when they were."""

    async def ready(self, instance: Instance) -> float:
        """Wait until the health tree holds on its own outputs, and return when it first did."""

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        """Run a procedure on the instance for at most ``within`` seconds, and report which state was restored.

        ``state`` is for the leaves of the procedure. Raises NotVerified, which names the leaf that failed and the reason.
        """

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        """Restore the state of the last healthy instance within ``within`` seconds. The report lists what could not be restored."""

    def follow(self, instances: Sequence[Instance]) -> None:
        """Keep a connection to each of these instances that has an agent, and to no other."""

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        """Return whether the health tree or the readiness check of the instance holds, and if not, why."""


class Outputs(Protocol):
    """The samples that arrive at the gated readers, which is what the robot receives."""

    @property
    def expected(self) -> Sequence[str]:
        """Gated topics that the health tree watches now. The active instance must publish each of them."""

    @property
    def blind(self) -> bool:
        """Whether DDS discovery has reported nobody to this process. Then a missing output says nothing about its instance."""

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        """Wait for a sample of each expected topic from the instance, received at ``since`` or later; return when the first came.

        Returns None if no topic is expected, or no longer is.
        """

    async def heard_held_back(self, instance: Instance) -> None:
        """Wait until the robot's side hears an instance that the gate holds back, if it must before it can let that instance through."""

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        """Return when a sample of another instance last passed the gate, and from which pod.

        The time is 0 if never.
        """

    def switched_to(self, instance: Instance) -> str:
        """Return to which other instance the robot's side has switched by itself from this one, which the gate names; empty if to none."""

    def period_of_others(self, instance: Instance) -> float:
        """Return the longest usual time in seconds between two samples of another instance on one topic; 0 if none was heard of late."""
