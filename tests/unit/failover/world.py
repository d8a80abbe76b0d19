"""A world for the failover protocol without ROS and without Kubernetes: pods, a gate and a robot that sees who drives it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field, replace

from understudy.api.protocol.kept_state import KeptState, Restored, RestoreReport
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import (
    ClaimLost,
    GateState,
    Instance,
    NoLongerNeeded,
    NotAvailable,
    NotVerified,
    Superseded,
)
from understudy.failover.pool_queue import Waiter
from understudy.failover.progress import Progress
from understudy.failover.strategies.base import StrategyContext

PERIOD = 0.005  # seconds between commands of a live instance
PROBE_PERIOD = 0.001  # seconds between probes in a burst


class Killed(BaseException):
    """The monitor's process ends here, whatever it was about to catch."""


@dataclass
class Leak:
    """Samples or probes that get past the gate, ``period`` seconds apart. Times are those of the world's clock."""

    period: float
    since: float
    until: float = math.inf


@dataclass
class Store:
    """What survives the monitor: the cluster, the journal and the robot's memory."""

    pods: dict[str, Instance] = field(default_factory=dict)
    broken: set[str] = field(default_factory=set)
    """Pods (by name) that never output anything."""
    gate: GateState = field(default_factory=GateState)
    watched: bool = False
    """Whether a monitor sees at once what others do to the gate."""
    journal: Progress | None = None
    commits: list[str] = field(default_factory=list)
    claims: dict[str, str] = field(default_factory=dict)
    started: set[str] = field(default_factory=set)
    deleted: list[str] = field(default_factory=list)
    deletion_takes: float = 0.0
    switched: dict[str, str] = field(default_factory=dict)
    """To which pod the robot's side has switched by itself from another one (both by name)."""
    blind: bool = False
    """Whether the monitor has discovered nobody."""
    heard_after: float = 0.0
    """Seconds until the robot's side hears an understudy that the gate holds back."""
    """Seconds until the API server answers."""
    unanswered_deletions: int = 0
    """How many deletions the API server does not answer."""
    gave_way: list[str] = field(default_factory=list)
    followed: set[str] = field(default_factory=set)
    """Pods whose agents a connection was asked for."""
    brought_up: list[tuple[str, str]] = field(default_factory=list)
    """The pods that were brought up, each with its procedure."""
    unwilling: set[str] = field(default_factory=set)
    """Pods (by name) whose procedures fail."""
    endless: set[str] = field(default_factory=set)
    """Pods (by name) whose procedures don't end before their time does."""
    silent: set[str] = field(default_factory=set)
    """Pods (by name) whose agents don't answer."""
    answering: set[str] = field(default_factory=set)
    """Pods (by name) whose agents report healthy outputs although Kubernetes reports the pod as not ready."""
    refusal: str = ""
    """Why no pod can be given any state."""
    refusals: float = math.inf
    """How often that happens."""
    others_claim: set[str] = field(default_factory=set)
    counter: itertools.count[int] = field(default_factory=lambda: itertools.count(1))
    source_makes_broken: bool = False
    beside: bool = False
    """Whether understudies are prepared while another instance drives, as in a planned switchover."""
    away: bool = False
    """Whether the API server does not answer."""
    unasked: bool = False
    """Whether nothing was asked of it since, so that nobody knows."""
    last_outage: tuple[float, float] | None = None
    """When its last outage began and ended, as a monitor remembers it."""
    kept: KeptState = field(default_factory=KeptState)
    """What was kept of the instance that failed."""
    kept_states: dict[str, KeptState] = field(default_factory=dict)
    restored: int = 0
    """How often state was restored."""
    restarts: int = 0
    """How often a pod restarts as soon as its state was restored."""
    """State by the name of the pod that was given it."""
    workload: str = "w"
    priority: int = 0
    unlabelled: set[str] = field(default_factory=set)
    """Pods (by name) whose label somebody removed, so no monitor lists them."""
    fleet: list[Store] = field(default_factory=list)
    """Stores of other workloads of the namespace, this one perhaps among them; its unclaimed pods are also theirs."""
    looks: list[str] = field(default_factory=list)
    """How unclaimed pods were looked for."""
    unlisted: bool = False
    """Whether the API server does not answer requests for unclaimed pods."""
    gateless: bool = False
    """Whether somebody deleted the gate, and nobody has created it again."""
    list_refusal: str = ""
    """Why the API server refuses requests for unclaimed pods."""
    other_parts: set[str] = field(default_factory=set)
    """Unclaimed pods (by name) that aren't in this workload's part of their pool."""
    stocked: set[str] = field(default_factory=set)
    """The shared pools that the operator says have a pod for it."""
    leaks: dict[str, Leak] = field(default_factory=dict)
    """Samples that arrive past the gate, by the name of the pod that sends them."""
    probes_through: dict[str, Leak] = field(default_factory=dict)
    """Probes that arrive past the gate, by the UID of the pod that sends them. A burst that is asked for is faster."""
    probed: set[str] = field(default_factory=set)
    """UIDs of the pods that were asked for a burst of probes."""
    messages: list[str] = field(default_factory=list)
    """The messages to users about its wait for a pod."""

    def add(self, name: str, **values: object) -> Instance:
        pod = replace(Instance(name=name, uid=f"uid-{name}", ip="10.0.0.1", running=True, ready=True), **values)  # type: ignore[arg-type]
        self.pods[name] = pod
        return pod

    def drives(self, name: str) -> bool:
        """Whether a pod's commands reach the robot now."""
        pod = self.pods.get(name)
        up = pod is not None and pod.running and (not pod.claim or name in self.started)
        return up and name not in self.broken and self.gate.active == name


class World:
    """One monitor process over a store, with the context of its strategies; ``dies_after`` kills it after so many effects."""

    def __init__(self, store: Store, *, dies_after: int | None = None) -> None:
        self.store = store
        self.effects = 0
        self.dies_after = dies_after
        self.found: list[Instance] = []
        """The unclaimed pods, as they were when they were looked for."""
        self.follows = False
        self.start_time = asyncio.get_running_loop().time()

    def clock(self) -> float:
        return asyncio.get_running_loop().time()

    def last_leaked(self, leak: Leak) -> float:
        """When a leaking pod was last heard."""
        now = min(self.clock(), leak.until)
        return now - (now - leak.since) % leak.period if now >= leak.since else 0.0

    def effect(self) -> None:
        """Count a step at which the process may be killed: once before it takes effect, once after."""
        self.effects += 1
        if self.dies_after is not None and self.effects > self.dies_after:
            raise Killed

    def context(self) -> StrategyContext:
        return StrategyContext(
            gate=_Gate(self),
            instances=_Instances(self),
            agents=Agents(self),
            outputs=Outputs(self),
            queue=_Queue(self),
            clock=self.clock,
            save=self._save,
            workload_uid="uid-w",
            kept=lambda onset: self.store.kept,
        )

    def _save(self, progress: Progress) -> None:
        self.effect()
        self.store.journal = progress.model_copy(deep=True)


class _Part:
    def __init__(self, world: World) -> None:
        self.world = world
        self.store = world.store


class _Gate(_Part):
    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._cached_gate = world.store.gate

    @property
    def exists(self) -> bool:
        return not self.store.gateless

    @property
    def state(self) -> GateState:
        if self.store.gateless:
            return GateState()
        return self.store.gate if self.store.watched else self._cached_gate

    async def commit(self, target: Instance | None, progress: Progress | None) -> GateState:
        self.world.effect()
        if progress is not None and self.state.closed and self.state.epoch == progress.open_at:
            raise NoLongerNeeded("somebody deleted the gate")
        while self.store.away:
            self.store.unasked = False
            await asyncio.sleep(PERIOD)
            late = progress.drives_late if progress is not None else None
            if late is not None and self.store.gate.active_uid == late.uid:
                raise NoLongerNeeded("it drives by now")
        if self.store.gate.epoch != self._cached_gate.epoch:
            raise Superseded("another monitor was first")
        await asyncio.sleep(0)  # no API server answers at once
        self.store.gate = GateState(
            epoch=self._cached_gate.epoch + 1,
            active=target.name if target else "",
            active_uid=target.uid if target else "",
            recovery=progress.model_copy(deep=True) if progress else None,
        )
        self.store.commits.append(target.name if target else "")
        self._cached_gate = self.store.gate
        self.world.effect()
        return self._cached_gate

    async def enforced(self, target: Instance, *, since: float) -> float:
        await asyncio.sleep(0.001)
        return self.world.clock()

    @property
    def unanswered_since(self) -> float | None:
        return self.world.start_time if self.store.away and not self.store.unasked else None

    @property
    def last_outage(self) -> tuple[float, float] | None:
        return self.store.last_outage

    def last_packet(self, uid: str) -> float | None:
        leak = self.store.probes_through.get(uid)
        if leak is not None and uid in self.store.probed:
            leak = replace(leak, period=PROBE_PERIOD)
        return self.world.last_leaked(leak) if leak is not None else None


class _Instances(_Part):
    def of_workload(self) -> Sequence[Instance]:
        return [p for p in self.store.pods.values() if not p.held and p.name not in self.store.unlabelled]

    def find(self, uid: str) -> Instance | None:
        return next((p for p in self.of_workload() if p.uid == uid), None)

    async def regain(self, name: str, uid: str) -> None:
        await asyncio.sleep(0.001)
        while self.store.away:
            await asyncio.sleep(PERIOD)
        self.store.unlabelled.discard(name)

    async def refresh_unclaimed(self, pool: str, *, part: bool = False) -> None:
        self.store.looks.append("part" if part else "all")
        await asyncio.sleep(0.001)
        while self.store.unlisted:
            await asyncio.sleep(PERIOD)
        if self.store.list_refusal:
            raise NotAvailable(self.store.list_refusal)
        found = (p for p in self.store.pods.values() if p.held and p.pool == pool)
        self.world.found = [p for p in found if not part or p.name not in self.store.other_parts]

    @contextlib.asynccontextmanager
    async def followed(self, pool: str) -> AsyncIterator[None]:
        self.store.looks.append("followed")
        self.world.follows = True
        try:
            yield
        finally:
            self.world.found, self.world.follows = list(self.unclaimed(pool)), False

    def stocked(self, pool: str) -> bool:
        return pool in self.store.stocked

    def unclaimed(self, pool: str) -> Sequence[Instance]:
        found = self.store.pods.values() if self.world.follows else self.world.found
        return [p for p in found if p.held and p.pool == pool]

    async def claim(self, instance: Instance, claim: str) -> Instance:
        self.world.effect()
        if instance.name in self.store.others_claim or instance.name not in self.store.pods:
            self.store.pods.pop(instance.name, None)
            raise ClaimLost(instance.name)
        assert instance.name not in self.store.claims, "a pod was claimed twice"
        self.store.claims[instance.name] = claim
        claimed = replace(instance, held=False, claim=claim)
        for other in self.store.fleet:
            other.pods.pop(instance.name, None)
        self.store.pods[instance.name] = claimed
        self.world.effect()
        return claimed

    async def retire(self, instance: Instance) -> None:
        self.world.effect()
        if self.store.unanswered_deletions:
            self.store.unanswered_deletions -= 1
            raise TimeoutError
        self.store.pods.pop(instance.name, None)
        self.store.deleted.append(instance.name)
        if self.store.deletion_takes:
            await asyncio.sleep(self.store.deletion_takes)
        self.world.effect()

    async def end(self, instance: Instance) -> None:
        await self.retire(instance)

    async def replace(self, failed: Sequence[Instance]) -> None:
        for instance in failed:
            await self.retire(instance)
        if not any(p.from_source for p in self.store.pods.values()):
            number = next(self.store.counter)
            self.store.add(f"w-new{number}")
            if self.store.source_makes_broken:
                self.store.broken.add(f"w-new{number}")

    async def wait(self, predicate: Callable[[Instance], bool]) -> Instance:
        while True:
            for pod in self.of_workload():
                if predicate(pod):
                    return pod
            await asyncio.sleep(PERIOD)


class _Queue(_Part):
    @property
    def workload(self) -> str:
        return self.store.workload

    @property
    def priority(self) -> int:
        return self.store.priority

    def others(self, pool: str) -> Sequence[Waiter]:
        notes = [store.gate.recovery for store in self.store.fleet if store is not self.store]
        return [note.waiting for note in notes if note is not None and note.waiting and note.waiting.pool == pool]

    def waits(self, me: Waiter, ahead: int, of: int) -> None:
        place = f"{ahead + 1} of {of}"
        if self.store.messages[-1:] != [place]:
            self.store.messages.append(place)

    def served(self, me: Waiter, pod: str) -> None:
        self.store.messages.append(f"served with {pod}")

    def gave_up(self, me: Waiter) -> None:
        self.store.messages.append("gave up")

    async def changed(self, pool: str) -> None:
        await asyncio.sleep(PERIOD)


class Agents(_Part):
    def _assert_behind_the_gate(self, instance: Instance, what: str) -> None:
        open_for_another = self.store.beside and self.store.gate.active != instance.name
        assert self.store.gate.closed or open_for_another, f"{what} while the gate was open"

    async def give_way(self, instance: Instance) -> None:
        self.store.gave_way.append(instance.name)

    async def probe(self, instance: Instance, duration: float) -> None:
        self.store.probed.add(instance.uid)

    async def start(self, instance: Instance) -> None:
        self.world.effect()
        self._assert_behind_the_gate(instance, "a process was started")
        decided_at = self.store.gate.epoch
        await asyncio.sleep(0)  # as a connection to the agent needs it
        if self.store.gate.epoch != decided_at:
            raise NotVerified("the gate was switched meanwhile")
        while instance.name in self.store.silent:
            await asyncio.sleep(PERIOD)
        self.store.started.add(instance.name)
        self.world.effect()

    async def up(self, instance: Instance) -> float:
        await asyncio.sleep(PERIOD)
        return self.world.clock()

    async def ready(self, instance: Instance) -> float:
        while instance.name in self.store.broken:
            await asyncio.sleep(PERIOD)
        await asyncio.sleep(PERIOD)
        return self.world.clock()

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        self.world.effect()
        self._assert_behind_the_gate(instance, "state was given")
        self.store.restored += 1
        if self.store.restored <= self.store.restarts:
            self.store.pods[instance.name] = replace(instance, restarts=self.store.restored)
        self.store.kept_states[instance.name] = state
        self.world.effect()
        if self.store.refusal and self.store.restored <= self.store.refusals:
            return state.none_restored(self.store.refusal)
        items = (*state.restored_samples, *state.parameters, *state.lifecycle)
        return RestoreReport(tuple(Restored(item.name, item.taken_at) for item in items), state.left_out)

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        self.world.effect()
        self._assert_behind_the_gate(instance, "an instance was brought up")
        self.store.brought_up.append((instance.name, procedure.name))
        await asyncio.sleep(PERIOD)
        if instance.name in self.store.endless:
            await asyncio.sleep(within)
            raise NotVerified(f"{procedure.name}.wait_for: node /nobody is not there")
        if instance.name in self.store.unwilling:
            raise NotVerified(f"agent {instance.name}: procedure: {procedure.name}.set_lifecycle: node /amcl is gone")
        self.world.effect()
        return state.none_restored("not tried") if state else RestoreReport()

    def follow(self, instances: Sequence[Instance]) -> None:
        self.store.followed = {instance.name for instance in instances}

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        ready = instance.ready or instance.name in self.store.answering
        return ready, "" if ready else "no /cmd_vel for 500 ms"


class Outputs(_Part):
    @property
    def expected(self) -> Sequence[str]:
        return ["/cmd_vel"]

    @property
    def blind(self) -> bool:
        return self.store.blind

    async def heard_held_back(self, instance: Instance) -> None:
        await asyncio.sleep(self.store.heard_after)

    async def first_from(self, instance: Instance, *, since: float) -> float:
        while self.store.blind or not self.store.drives(instance.name):
            await asyncio.sleep(PERIOD)
        await asyncio.sleep(PERIOD)
        return self.world.clock()

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        leaks = [(self.world.last_leaked(leak), name) for name, leak in self.store.leaks.items()]
        if self.store.beside and (former := self.store.gate.recovery and self.store.gate.recovery.former):
            leaks.append((self.world.clock() - 10.0, former.name))
        return max(leaks, default=(0.0, ""))

    def switched_to(self, instance: Instance) -> str:
        return self.store.switched.get(instance.name, "")

    def period_of_others(self, instance: Instance) -> float:
        return max((leak.period for leak in self.store.leaks.values()), default=PERIOD)
