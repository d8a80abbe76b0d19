"""What a monitor knows of its robot and of its instances' agents, where the real one has DDS and connections."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots
from tests.unit.interleavings.scheduling import Process
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.clock import CLOCK
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.failover.pinned import PinnedPod
from understudy.kube.gates.base import Proof
from understudy.monitor.observe.robot.known_senders import (
    REMEMBERED,
    Caller,
    KnownSender,
    KnownSenders,
    OutputSender,
    host_at,
)
from understudy.trees.core.health_tree import Verdict

GAP = 0.5
"""Seconds of silence after which an instance in control has failed."""

GRACE = 5.0
"""Seconds that a new instance has to be heard for the first time."""

HEARD_WITHIN = 1.0
"""The same for one that had driven before the monitor started."""

TOPIC = "/cmd_vel"

RECENT = 2.0
"""Seconds for which a monitor knows the rate of a sender."""


class SafeCommander:
    """A publisher of safe commands. Its graph is the observer of the robot that receives them."""

    def __init__(self, observer: HealthObserver, topic: str, type_name: str, message: Mapping[str, Any]) -> None:
        self._observer = observer

    def publish(self) -> None:
        """Send a safe command to the robot."""
        self._observer.command_safely()

    def close(self) -> None:
        return


class HealthObserver:
    """The samples that arrive at the gated readers of one robot. They are known by the addresses of their senders."""

    coming = None
    problems: Sequence[str] = ()
    waiting: Sequence[str] = ()
    summary = "Watching what reaches the robot."
    addresses: Mapping[str, str] = {}

    def __init__(self, process: Process, robots: Robots, workload: str, looked: Callable[[], None]) -> None:
        """Times are those of the monitor's clock. ``looked`` is called with every look of the monitor."""
        self._robots, self._workload, self._looked = robots, workload, looked
        self._clock = process.stamp
        self._active = ""
        self._expected_since = self._expected_by = -math.inf
        self._senders = KnownSenders()
        self.known_since: dict[str, float] = {}
        """By UID, since when (Unix seconds) it knows an instance."""
        self.graph, self.sees_nobody = self, False

    def unreached(self, pod: str) -> str:
        """No topic: whether the robot receives an instance is not known."""
        return ""

    @property
    def drove_on_board(self) -> bool:
        """False: there is no instance on board."""
        return False

    def command_safely(self) -> None:
        """This monitor sends its robot a safe command."""
        self._robots.commanded_safely(self._workload)

    def _at(self, ip: str) -> Running | None:
        """Who sends from an address."""
        return next((r for r in self._robots.running.values() if r.ip == ip and r.robot == self._workload), None)

    def _named(self, name: str) -> Running | None:
        sender = self._senders.named().get(name)
        return self._at(sender.ip) if sender is not None and sender.attributed else None

    def follow(self, policy: Any, spec: Any) -> None:
        return

    def drain(self, instances: Sequence[Instance], active: str, pinned: Sequence[PinnedPod] = ()) -> None:
        self._active = active
        self._senders.update(instances, pinned, lambda ip: self._last(self._at(ip)), self.now)
        for one in self._senders.all():
            self.known_since.setdefault(one.uid, self._robots.now)
        self._looked()

    def _last(self, found: Running | None) -> float | None:
        last = found.last_arrival(self._robots.now) if found is not None else None
        return self._stamp(last) if last is not None else None

    @property
    def now(self) -> float:
        """The time."""
        return self._clock(self._robots.now)

    def _stamp(self, moment: float) -> float:
        """A moment by the monitor's clock as it is set now: the receive times of samples move with the clock."""
        return self.now - (self._robots.now - moment)

    def first(self, found: Running, since: float) -> float | None:
        """When a sample of an instance first arrived at or after a time."""
        now = self._robots.now
        first = found.first_arrival(now - (self.now - since), now)
        return self._stamp(first) if first is not None else None

    def last_from(self, pod: str) -> float | None:
        return self._last(self._named(pod))

    last_well = last_from

    def new_process(self, pod: str, *, since: float) -> bool:
        found = self._named(pod)
        return found is None or found.up_at is None or self._stamp(found.up_at) >= since

    def processes(self, pod: str) -> frozenset[bytes]:
        return frozenset()

    def discovered(self, instance: Instance) -> bool:
        """Whether its application runs. Discovery takes no time."""
        found = self._at(instance.ip)
        return found is not None and found.up

    hears_nobody, unheard, awaited = False, "", ()

    def others_discovered(self, instance: Instance) -> bool:
        """Always: the robot's reader."""
        return True

    def expect_samples(self, *, since: float, heard_from: float) -> None:
        self._expected_since, self._expected_by = since, heard_from + HEARD_WITHIN

    def _received_since(self, since: float) -> float | None:
        last = self.last_from(self._active)
        return last if last is not None and last >= since else None

    def verdict(self, *, now: float, since: float) -> Verdict:
        last = self._received_since(since)
        if last is None:
            if now < (self._expected_by if self._expected_since == since else since + GRACE):
                return Verdict("Starting", "not heard yet", "topic", None)
            return Verdict("Failed", f"{TOPIC} was never heard", "topic", self.last_from(self._active))
        if now - last >= GAP:
            return Verdict("Failed", f"no {TOPIC} for {GAP} s", "topic", last)
        return Verdict("Healthy", "", "", None)

    def deadline(self, *, now: float, since: float) -> float | None:
        """None while samples arrive in time: the simulation wakes the monitor when that changes."""
        last = self._received_since(since)
        if last is None:
            return self._expected_by if self._expected_since == since else since + GRACE
        found = self._named(self._active)
        return None if found is not None and found.through and found.period < GAP else last + GAP

    def outputs(self, fleet: Any, gate: Any) -> Outputs:
        return Outputs(self, self._robots, self._workload, fleet, gate)

    def known_senders(self) -> Sequence[KnownSender]:
        return self._senders.all()

    def callers(self) -> Sequence[Caller]:
        return ()

    def output_senders(self) -> Sequence[OutputSender]:
        known = {sender.ip: sender for sender in self._senders.all()}
        found: list[OutputSender] = []
        for running in self._robots.running.values():
            last = self._last(running) if running.robot == self._workload else None
            if last is None or self.now - last > REMEMBERED:
                continue
            sender = known.get(running.ip)
            name, uid = (sender.name, sender.uid) if sender is not None else ("an unnamed node", "")
            may_be = (uid,) if uid else ()
            found.append(OutputSender(TOPIC, name, uid, may_be, last, host_at(running.ip), running.period))
        return found


class Outputs:
    """What the failover protocol sees of it."""

    expected: Sequence[str] = (TOPIC,)

    def __init__(self, observer: HealthObserver, robots: Robots, workload: str, fleet: Any, gate: Any) -> None:
        self._observer, self._robots, self._workload = observer, robots, workload
        self._fleet, self._gate = fleet, gate

    def _drain(self) -> None:
        state = self._gate.state
        self._observer.drain(self._fleet.of_workload(), state.active, state.pinned)

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        while True:
            self._drain()
            found = self._observer._named(instance.name)
            first = self._observer.first(found, CLOCK.to_system(since)) if found is not None else None
            if first is not None:
                return CLOCK.of_system(first)
            # The next sample of an instance that drives all the time is no event of the robots.
            within = found.period if found is not None and found.sends and found.through else None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(within):
                    await self._robots.wait(self._workload)

    blind = False

    async def heard_held_back(self, instance: Instance) -> None:
        return

    def _others(self, instance: Instance) -> Iterator[tuple[str, Running]]:
        self._drain()
        for name, sender in self._observer._senders.named().items():
            found = self._observer._at(sender.ip) if sender.attributed else None
            if found is not None and name != instance.name:
                yield name, found

    def heard(self) -> Sequence[tuple[float, float]]:
        self._drain()
        return [(CLOCK.of_system(sender.last), sender.interval) for sender in self._observer.output_senders()]

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        others, heard = self._others(instance), self._observer._last
        found = [(CLOCK.of_system(last), name) for name, other in others if (last := heard(other)) is not None]
        return max(found, default=(0.0, ""))

    def switched_to(self, instance: Instance) -> str:
        return ""

    def period_of_others(self, instance: Instance) -> float:
        now = self._robots.now
        periods = [r.period for _, r in self._others(instance) if now - (r.last_arrival(now) or 0.0) < RECENT]
        return max(periods, default=0.0)


class Probes(Proof):
    """What gets through the gate, whether the application sends or not."""

    def __init__(self, process: Process, robots: Robots, workload: str) -> None:
        self._robots, self._workload, self._stamp = robots, workload, process.stamp

    async def wait(self, uid: str, after: float, within: float | None = None) -> float:
        while True:
            found = self._robots.running.get(uid)
            if found is not None and found.routed_at is not None:
                return max(after, CLOCK.of_system(self._stamp(found.routed_at)))
            await self._robots.wait(self._workload)

    def last(self, uid: str) -> float | None:
        found = self._robots.running.get(uid)
        return self._stamp(self._robots.now) if found is not None and found.routed_at is not None else None

    def heard_since(self, time: float) -> Sequence[str]:
        found = self._robots.running.values()
        return [r.uid for r in found if r.robot == self._workload and r.routed_at is not None]


class AgentConnections:
    """The agents of a workload's instances."""

    newest_epoch = 0

    def __init__(self, robots: Robots, workload: str, step: Callable[[str], None], *, initializes: bool) -> None:
        """``initializes``: a standby is ready once a procedure has brought it there."""
        self._robots, self._workload, self._step = robots, workload, step
        self._initializes = initializes
        self._known: set[str] = set()
        self.started: Callable[[Instance], None] = lambda instance: None
        """Called when the processes of a claimed instance are started."""

    def follow(self, instances: Sequence[Instance]) -> None:
        self._known = {i.uid for i in instances if i.ip and not i.held and not i.leaving}

    async def settle(self, instances: Sequence[Instance], within: float) -> None:
        await asyncio.sleep(0.05)
        self.follow(instances)

    def _found(self, instance: Instance) -> Running | None:
        found = self._robots.running.get(instance.uid)
        return found if found is not None and found.up else None

    def status(self, instance: Instance) -> AgentStatus | None:
        found = self._found(instance)
        if found is None or instance.uid not in self._known or not instance.has_agent:
            return None
        at = found.sends_since if found.sends else None
        phase: Any = "Held" if found.held else "Running"
        return AgentStatus(
            phase=phase,
            configured=True,
            ready=found.stands_by and (bool(found.brought) or not self._initializes),
            ready_at=at,
            process_up_at=found.up_at,
            initialized=found.brought,
        )

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        status = self.status(instance)
        if status is None:
            return False, "its agent is not connected"
        return status.ready, "" if status.ready else "its outputs are not healthy"

    async def probe(self, instance: Instance, duration: float) -> None:
        return

    async def give_way(self, instance: Instance) -> None:
        return

    async def start(self, instance: Instance) -> None:
        self._step("before start")
        while self._found(instance) is None:
            await asyncio.sleep(0.1)
        await asyncio.sleep(self._robots.network.delay())
        self.started(instance)
        self._robots.start(instance.uid, self._workload)
        await asyncio.sleep(self._robots.network.delay())
        self._step("after start")

    async def up(self, instance: Instance) -> float:
        while (found := self._found(instance)) is None or found.held:
            await asyncio.sleep(0.1)
        assert found.up_at is not None
        return found.up_at

    async def ready(self, instance: Instance) -> float:
        while (found := self._found(instance)) is None or not found.sends:
            await self._robots.wait(self._workload)
        return found.sends_since

    async def run(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState, brought: str
    ) -> RestoreReport:
        choices, failing = self._robots.choices, self._robots.luck.failing
        fails = choices.random() < failing
        await asyncio.sleep(within if fails and choices.random() < 0.5 else 0.1 + self._robots.network.delay())
        if fails:
            raise NotVerified(f"{procedure.name} of {instance.name} failed")
        if self._found(instance) is None:
            raise NotVerified(f"{procedure.name} of {instance.name}: its agent is not connected")
        self._robots.bring(instance.uid, brought)
        return RestoreReport()

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        self._step("before bring up")
        brought = f"up:{procedure.digest}:{instance.restarts}"
        report = await self.run(instance, procedure, within=within, state=state, brought=brought)
        self._step("after bring up")
        return report

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        return RestoreReport()
