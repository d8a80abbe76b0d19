"""Runs with a reflex: robots whose readers fall over by themselves, and monitors that follow.

The real code of the monitor's reflex and leases, of the strategies, and of the agents' strengths and fences runs over a
model of readers with exclusive ownership (ownership.py), of pods (agents.py), and of a network whose nodes can be cut
off: from everybody, or from some. A node enforces the gate as it was told last, and one that comes back is told after a
while. What must hold, beside what always must (invariants.py):

- Whom a gate doesn't let through any more, the robot doesn't take any more. The network has a moment to follow, and a pod
  that was cut off from everybody is held. It may go on until its node has been told where the node was back before it could be
  noticed, where its agent had never heard from a monitor, and where a monitor has let it go on before it was shut out, or
  before that one could know. A pod whose object is gone no policy holds back.
- A process that starts after its agent was asked to give way is never taken, whoever is late.
- A gate lets the pod in control through and at most one standby, which is weaker at that moment. Letting one through, or no
  longer, is no commit: neither epoch nor control change. Each commit is of the next epoch, and lets one through alone.
- A robot whose gate lets a standby through that works and is reached is without commands for the deadline, a period and a moment at
  most, whatever becomes of the pod in control, the monitor and the API server.
- A recovery that began with the reflex leaves the robot to the standby that took over, for as long as that works.
- Where the network is well and the monitor works, no robot is without commands for long while a standby works.

And in the end: each robot takes the commands of the pod that its gate names, every monitor hears the same, nobody who is
in control or stands by is held, and a standby is let through again.
"""

from __future__ import annotations

import asyncio
import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from tests.unit.interleavings import simulation
from tests.unit.interleavings.actors import NAMESPACE, Monitor
from tests.unit.interleavings.agents import Agent, Questions, Sessions
from tests.unit.interleavings.apiserver import EPOCH, Place
from tests.unit.interleavings.invariants import Invariants
from tests.unit.interleavings.network import Weather
from tests.unit.interleavings.ownership import PERIOD, Reader, Writer
from tests.unit.interleavings.robots import NODES, Robots, Running
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.senses import GAP, Outputs, Probes, Sidecars, Sight
from tests.unit.interleavings.simulation import ROBOTS, TROUBLES, Outcome, Scene, Simulation
from understudy.agent import preparing
from understudy.agent.fencing import Fence
from understudy.agent.sessions import Peer
from understudy.agent.strengths import Strengths
from understudy.api import names, strengths
from understudy.api.agents import SILENCE, AgentStatus
from understudy.api.base import seconds
from understudy.api.workloads import Reflex
from understudy.cluster import gates
from understudy.cluster.agents import AgentGone
from understudy.cluster.client import Client, Object
from understudy.mitigation.interfaces import Instance
from understudy.mitigation.progress import Progress
from understudy.monitor.leases import Leases
from understudy.monitor.sidecars import ANSWER_LATE
from understudy.monitor.supervising import Parts
from understudy.ros import ownership

FIRST = 1_000_000
"""From this seed on runs are of the reflex."""

EVERYBODY = frozenset({"robot", "monitor", "nodes", "API server"})
"""Whom a node can be cut off from."""

SOME = (frozenset({"robot"}), frozenset({"monitor"}), frozenset({"robot", "monitor"}), frozenset({"nodes"}))

ENFORCED = 0.05
"""Seconds in which nodes follow a gate."""

TOLD_AGAIN = 0.5
"""Most seconds after which a node that was cut off knows the gates again."""

UNNOTICED = 0.6
"""Seconds for which a node may be cut off without its pods being held."""

DISCOVERY = 1.0
"""Most seconds until a new reader has discovered a writer."""

LOOK = 0.2
"""Seconds between two looks whether a robot is without commands."""

SKEW = 0.2
"""Most seconds by which nodes' clocks differ."""

STARVED = 30.0
"""Seconds within which a monitor that works has a standby that works drive: the times that two strategies get, and the grace of an
instance that was never heard.
"""

SCENES = (
    Scene("reflex", workloads=2, strategies=("hot", "Restart"), standbys=1, reflex="300ms"),
    Scene("reflex and claims", workloads=2, strategies=("hot", "spare", "Restart"), spares=1, standbys=1, reflex="300ms"),
    Scene("reflex, two standbys", workloads=1, strategies=("hot", "Restart"), standbys=2, reflex="300ms"),
)


@dataclass
class Watching:
    """A monitor's reader. What sends already it discovers one after the other."""

    process: Process
    reader: Reader
    since: float
    known: dict[Writer, float] = field(default_factory=dict)
    """By when it has discovered writers."""


@dataclass
class ReflexRobots(Robots):
    """Robots whose readers choose, and nodes that can be cut off."""

    folder: Path = Path()
    reflex: Reflex = field(default_factory=Reflex)
    agents: dict[str, Agent] = field(default_factory=dict)
    """By UID."""
    readers: dict[str, Reader] = field(default_factory=dict)
    """The robots', by workload."""
    watching: dict[str, list[Watching]] = field(default_factory=dict)
    """The monitors', by workload."""
    cuts: dict[str, frozenset[str]] = field(default_factory=dict)
    """By node, whom it doesn't reach."""
    cut_at: dict[str, float] = field(default_factory=dict)
    back_at: dict[str, float] = field(default_factory=dict)
    apart: set[str] = field(default_factory=set)
    """Workloads whose monitors reach nobody."""
    told: Callable[[str], None] = lambda robot: None
    """Called when an agent of a robot's instances has something to say."""
    seen: Counter[str] = field(default_factory=Counter)
    prepared_at: float = 0.0
    """When the pod that was prepared last was, by its node's clock."""
    _enforced: dict[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    _stale: set[str] = field(default_factory=set)
    """Nodes whose policy engines haven't heard from the API server since they are back."""
    _put_off: dict[str, list[Callable[[], None]]] = field(default_factory=dict)
    _clocks: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.process = self.loop.process("agents")
        self._clocks = {node: self.between(0, SKEW) for node in NODES}

    def take_up(self) -> None:
        """Go on with what runs already."""
        for found in self.running.values():
            if not found.held:
                self._prepare(found, at=found.up_at)
                if found.sends:
                    self.agents[found.uid].begin()
                    self.agents[found.uid].seen()
        for robot in self.let_through:
            for node in NODES:
                self._enforced[node, robot] = self.let_through[robot]
            self._route(robot)

    def clock(self, node: str) -> float:
        """The time by a node's clock."""
        return self.now + self._clocks[node]

    def reader_of(self, robot: str) -> Reader:
        """The robot's own reader."""
        if robot not in self.readers:
            self.readers[robot] = self._reader(robot)
        return self.readers[robot]

    def _reader(self, robot: str) -> Reader:
        deadline = seconds(self.reflex.deadline)
        return Reader(deadline, lambda: self.now, self.later, functools.partial(self._tell, robot))

    def watch(self, process: Process, robot: str) -> Reader:
        """A new monitor's reader."""
        made = Watching(process, self._reader(robot), self.now)
        self.watching[robot] = [w for w in self.watching.get(robot, []) if w.process.alive] + [made]
        self._route(robot)
        return made.reader

    # -- who reaches whom -------------------------------------------------------------------------------------------

    def reaches(self, node: str, party: str, robot: str = "") -> bool:
        """Whether a node reaches one; of a monitor ``robot`` says which."""
        return party not in self.cuts.get(node, ()) and not (party == "monitor" and robot in self.apart)

    def _answers(self, uid: str, host: str) -> bool:
        """Whether an address answers a pod's agent."""
        found = self.running[uid]
        if host == found.robot:
            return self.reaches(found.node, "monitor", host)
        if host == ROBOTS.partition("/")[0]:
            return self.reaches(found.node, "robot")
        other = next((r for r in self.running.values() if r.ip == host and not r.ended), None)
        return other is not None and self.reaches(found.node, "nodes") and self.reaches(other.node, "nodes")

    def cut(self, node: str, parties: frozenset[str]) -> None:
        """A node reaches these no more."""
        if self.cuts.get(node):
            return
        self.noted(f"node {node} is cut off from {', '.join(sorted(parties))}")
        self.cuts[node], self.cut_at[node] = parties, self.now
        for found in [r for r in self.running.values() if r.node == node and not r.ended]:
            self._ask(found)
        self._reroute()

    def join(self, node: str) -> None:
        """A node reaches everybody again. What it knows is old for a while yet."""
        parties = self.cuts.pop(node, frozenset())
        if not parties:
            return
        self.noted(f"node {node} is back")
        self.back_at[node] = self.now
        if "API server" in parties:
            self._stale.add(node)
            self.later(self.between(0.1, TOLD_AGAIN - 0.05), self._catch_up, node)
            for work in self._put_off.pop(node, []):
                self.later(self.between(0.02, 0.4), work)
        self._reroute()
        for found in [r for r in self.running.values() if r.node == node]:
            self.told(found.robot)

    def _reroute(self) -> None:
        for robot in sorted({found.robot for found in self.running.values() if found.robot}):
            self._route(robot)

    def _ask(self, found: Running) -> None:
        """Its agent's fence has something to do. Until now everybody has answered it."""
        agent = self.agents.get(found.uid)
        if agent is None or agent.asking:
            return
        agent.unfenced = agent.fence._monitor is None
        if agent.unfenced:
            return
        agent.asking = True
        agent.fence._lease.answered(self.loop.time())
        task = self.loop.start(self.process, agent.fence.run())

        def rest() -> None:
            if found.ended or (not self.cuts.get(found.node) and not agent.holds):
                agent.asking = False
                task.cancel()
            else:
                self.later(1.0, rest)

        self.later(1.0, rest)

    def _changed(self, uid: str) -> None:
        """An agent holds its application, or lets it go."""
        found = self.running[uid]
        if self.agents[uid].holds:
            self.seen["held"] += 1
        self.noted(f"pod {found.name}: {self.agents[uid].fence.reason or 'goes on'}")
        self._route(found.robot)
        self.told(found.robot)

    # -- nodes ------------------------------------------------------------------------------------------------------

    def _away(self, uid: str, work: Callable[..., None], *args: Any) -> bool:
        """Whether a pod's node hears nothing of the API server; then this is done when it does."""
        found = self.running.get(uid)
        if found is None or self.reaches(found.node, "API server"):
            return False
        self._put_off.setdefault(found.node, []).append(functools.partial(work, *args))
        return True

    def _run(self, uid: str, place: Place) -> None:
        super()._run(uid, place)
        if (found := self.running.get(uid)) is not None and not found.held:
            self._prepare(found)

    def _prepare(self, found: Running, at: float | None = None) -> None:
        """Its init container runs: now, or it did then."""
        self.prepared_at = (at or self.now) + self._clocks[found.node]
        folder = self.folder / found.uid
        folder.mkdir(exist_ok=True)
        sessions = Sessions(lambda: self.reaches(found.node, "monitor", found.robot))
        fence = Fence(folder, ("app",), on_change=functools.partial(self._changed, found.uid))
        fence._questions = cast(Any, Questions(functools.partial(self._answers, found.uid)))
        fence.contacts = sessions
        strengths = Strengths(folder, clock=functools.partial(self.clock, found.node))
        agent = Agent(found.uid, folder, strengths, fence, sessions, self.choices.random)
        agent.prepare(f"<profile>{ownership.instance_writer(self.reflex)}</profile>")
        self.agents[found.uid] = agent

    def start(self, uid: str, workload: str) -> None:
        found = self.running.get(uid)
        if found is not None and found.held and not found.ended:
            found.robot = workload
            self._prepare(found)
        super().start(uid, workload)

    def _up(self, uid: str) -> None:
        if not self._away(uid, self._up, uid):
            super()._up(uid)

    def status(self, uid: str, phase: str, ready: bool, reason: str = "") -> None:
        if not self._away(uid, self.status, uid, phase, ready, reason):
            super().status(uid, phase, ready, reason)

    def heartbeat(self, uid: str) -> None:
        if not self._away(uid, self.heartbeat, uid):
            super().heartbeat(uid)

    def _end(self, uid: str) -> None:
        if self._away(uid, self._end, uid):
            return
        if uid in self.agents:
            self.agents[uid].left = True
        super()._end(uid)

    def _send(self, uid: str) -> None:
        found, agent = self.running.get(uid), self.agents.get(uid)
        if found is not None and agent is not None and not (found.ended or found.broken or found.sends):
            if agent.holds:  # the script waits before it starts its command
                self.later(0.5, self._send, uid)
                return
            agent.begin()
            self.later(self.between(0.05, 0.3), self._seen, uid, agent.process)
        super()._send(uid)

    def _seen(self, uid: str, process: int) -> None:
        agent = self.agents[uid]
        if agent.process == process and not self.running[uid].ended:
            agent.seen()
            self.told(self.running[uid].robot)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def freeze(self, uid: str) -> None:
        if uid in self.agents:
            self.agents[uid].silent_since = self.now
        super().freeze(uid)

    def crash(self, uid: str) -> None:
        if (agent := self.agents.get(uid)) is not None:
            if agent.strengths.range is not None:
                agent.seen()  # until now
            agent.silent_since, agent.hangs = 0.0, False
        super().crash(uid)

    def hang(self, uid: str, seconds: float) -> None:
        """An application stands still for a while."""
        agent = self.agents.get(uid)
        if agent is None or agent.hangs:
            return
        agent.hangs, agent.silent_since = True, self.now
        self._route(self.running[uid].robot)
        self.later(seconds, self.thaw, uid, agent.process)

    def thaw(self, uid: str, process: int) -> None:
        """It goes on as if nothing had been."""
        agent = self.agents[uid]
        if agent.hangs and agent.process == process:
            self.noted(f"pod {self.running[uid].name}: thaws")
            agent.hangs = False
            self._route(self.running[uid].robot)
            self.told(self.running[uid].robot)

    # -- what reaches the robots ------------------------------------------------------------------------------------

    def _enforce(self, workload: str) -> None:
        super()._enforce(workload)
        for node in NODES:
            self.later(self.between(0.0, 0.02), self._enforce_at, node, workload)

    def _enforce_at(self, node: str, workload: str) -> None:
        if self.reaches(node, "API server") and node not in self._stale:
            policy = self.server.get("networkpolicies", (NAMESPACE, names.gate(workload)))
            self._enforced[node, workload] = gates.selected(policy) if policy is not None else ()
            self._route(workload)

    def _catch_up(self, node: str) -> None:
        if not self.reaches(node, "API server"):
            return  # it is cut off again
        self._stale.discard(node)
        for workload in sorted(self.let_through):
            self._enforce_at(node, workload)

    def _selected(self, found: Running, robot: str, allowed: tuple[str, ...]) -> bool:
        return super()._selected(found, robot, self._enforced.get((found.node, robot), ()))

    def _let_flow(self, robot: str) -> None:
        super()._let_flow(robot)
        reader = self.reader_of(robot)
        for found in self.running.values():
            if found.robot != robot or (agent := self.agents.get(found.uid)) is None:
                continue
            works = found.through and not agent.hangs and not agent.holds
            writer = agent.writer if works else None
            reached = writer if self.reaches(found.node, "robot") else None
            agent.reaches_since = (agent.reaches_since or self.now) if reached is not None else None
            reader.hear(found.uid, reached, left=agent.left)
            heard = writer if self.reaches(found.node, "monitor", robot) else None
            for watching in self.watching.get(robot, ()):
                known = heard is not None and self._discovered(watching, heard, robot)
                watching.reader.hear(found.uid, heard if known else None, left=agent.left)

    def _discovered(self, watching: Watching, writer: Writer, robot: str) -> bool:
        if writer not in watching.known:
            new = self.now - watching.since < DISCOVERY
            watching.known[writer] = self.now + (self.between(0.0, DISCOVERY) if new else 0.0)
            if new:
                self.later(watching.known[writer] - self.now, self._route, robot)
        return watching.known[writer] <= self.now


class ReflexSight(Sight):
    """What a monitor's reader takes."""

    def __init__(self, robots: ReflexRobots, workload: str, looked: Callable[[], None], reader: Reader) -> None:
        super().__init__(robots, workload, looked)
        self._reader = reader

    def _last(self, found: Running | None) -> float | None:
        return self._reader.last(found.uid) if found is not None else None

    def arrivals(self, topic: str, pod: str) -> list[float]:
        found = self._named(pod)
        return self._reader.arrivals(found.uid) if found is not None else []

    def ambiguous(self, pod: str) -> bool:
        return False

    def outputs(self, fleet: Any, gate: Any) -> Outputs:
        return ReflexOutputs(self._robots, self._workload, self._reader)


class ReflexOutputs(Outputs):
    """What the failover protocol sees of it."""

    def __init__(self, robots: Robots, workload: str, reader: Reader) -> None:
        super().__init__(robots, workload)
        self._reader = reader

    async def first_from(self, instance: Instance, *, since: float) -> float | None:
        while (first := self._reader.first(instance.uid, since)) is None:
            if self._reader.driver == instance.uid:
                await asyncio.sleep(PERIOD)
            else:
                await self._robots.wait(self._workload)
        return first

    def last_from_others(self, instance: Instance) -> tuple[float, str]:
        others = [r for r in self._robots.running.values() if r.robot == self._workload and r.uid != instance.uid]
        lasts = [(last, r.name) for r in others if (last := self._reader.last(r.uid)) is not None]
        return max(lasts, default=(0.0, ""))


class ReflexProbes(Probes):
    """What gets through the gate to a monitor that is reached."""

    def _reached(self, uid: str) -> bool:
        robots = cast(ReflexRobots, self._robots)
        found = robots.running.get(uid)
        return found is not None and robots.reaches(found.node, "monitor", self._workload)

    async def wait(self, uid: str, after: float, within: float | None = None) -> float:
        while True:
            found = await super().wait(uid, after, within)
            if self._reached(uid):
                return found
            await self._robots.wait(self._workload)

    def last(self, uid: str) -> float | None:
        return super().last(uid) if self._reached(uid) else None


class ReflexSidecars(Sidecars):
    """Agents that say how strong their instances are, and are told who may let them go on."""

    def __init__(self, *given: Any, **more: Any) -> None:
        super().__init__(*given, **more)
        self._said: dict[str, tuple[AgentStatus, float]] = {}
        self.believed: Callable[[str], bool] = lambda uid: False
        """Whether its monitor takes a pod for one that the gate names."""
        self.shut_out: Callable[[str], bool] = lambda uid: False
        """Whether the gate has shut a pod out, whoever knows."""

    @property
    def _world(self) -> ReflexRobots:
        return cast(ReflexRobots, self._robots)

    def _found(self, instance: Instance) -> Running | None:
        found = super()._found(instance)
        return found if found is not None and self._world.reaches(found.node, "monitor", self._workload) else None

    def status(self, instance: Instance) -> AgentStatus | None:
        robots, agent = self._world, self._world.agents.get(instance.uid)
        found, status = self._found(instance), super().status(instance)
        if found is None:
            # A connection that says nothing is given up after a while.
            said, at = self._said.get(instance.uid, (None, 0.0))
            return said if robots.now - at < SILENCE else None
        if status is not None and agent is not None:
            # Only with the policy's gap is silence noticed.
            works = (found.sends and not agent.hangs) or robots.now - agent.silent_since < GAP
            strength = agent.strengths.range if agent.process else None
            status = replace(
                status, ready=works and not agent.holds, strength=strength, cut_off=agent.fence.since
            )
        if status is not None:
            self._said[instance.uid] = (status, robots.now)
        return status

    def session(self, instance: Instance) -> tuple[int, int]:
        agent = self._world.agents.get(instance.uid)
        return (0, 0) if agent is None else (1, agent.sessions.number)

    async def lease(self, instance: Instance, body: Mapping[str, Any]) -> None:
        agent = self._world.agents.get(instance.uid)
        if agent is None or self._found(instance) is None:
            await asyncio.sleep(ANSWER_LATE)
            raise AgentGone(f"{instance.name}: its agent isn't connected")
        if body.get("word") == "Go":
            agent.believed = self.believed(instance.uid) or not self.shut_out(instance.uid)
        await asyncio.sleep(self._robots.network.delay())
        await agent.fence.lease(body, Peer(self._workload, instance.claim, self._workload))

    async def give_way(self, instance: Instance) -> None:
        agent = self._world.agents.get(instance.uid)
        if agent is not None and self._found(instance) is not None:
            self._robots.later(self._robots.network.delay(), agent.give_way)


class ReflexMonitor(Monitor):
    """One whose reader is like the robot's."""

    def __init__(self, process: Process, network: Any, robots: ReflexRobots, workload: str, *rest: Any, **more: Any) -> None:
        self.reader = robots.watch(process, workload)
        super().__init__(process, network, robots, workload, *rest, **more)

    def _make_sidecars(self, *, initializes: bool) -> Sidecars:
        return ReflexSidecars(self._robots, self.workload, self.fuse.step, initializes=initializes)

    def _make_sight(self) -> Sight:
        return ReflexSight(cast(ReflexRobots, self._robots), self.workload, self._look_at_gate, self.reader)

    def _make_probes(self) -> Probes:
        return ReflexProbes(self._robots, self.workload)

    def _beside(self, client: Client, parts: Parts, group: asyncio.TaskGroup) -> None:
        graph = SimpleNamespace(subscribers=lambda topic: ())  # the robot is told of by its address
        sight = cast(Any, SimpleNamespace(graph=graph))
        leases = Leases(client, parts.view, parts.fleet, parts.gate, parts.sidecars, sight, parts.reporter)
        leases.recovering = lambda: self.supervisor.recovering if self.supervisor is not None else None

        def believed(uid: str) -> bool:
            state, recovering = parts.gate.state, leases.recovering()
            lost = recovering is not None and recovering.taken_over is not None and recovering.has_failed(uid)
            return uid in (state.active_uid, state.admitted_uid) and not lost

        cast(ReflexSidecars, self.sidecars).believed = believed

        def on_status() -> None:
            self.wake()
            leases.wake.set()

        self.sidecars.on_status = on_status
        group.create_task(leases.run())

    def says(self, condition: str) -> str:
        """Why it says that a condition is as it is."""
        said = self._reporter._body()["status"]["conditions"] if self._reporter is not None else []
        return next((f"{c['reason']}: {c['message']}" for c in said if c["type"] == condition), "")


class ReflexInvariants(Invariants):
    """See above."""

    most_through = 2

    def __init__(
        self, *given: Any, excused: Callable[[str], bool], says: Callable[[str], str], **more: Any
    ) -> None:
        """``excused`` tells whether a robot's monitor, or the network, can't be expected to work now; ``says`` what that says of
        the reflex.
        """
        super().__init__(*given, **more)
        self._excused, self._says = excused, says
        self.robots = cast(ReflexRobots, self._robots)
        self._shut_out: dict[str, dict[str, float]] = {}
        """By workload and UID, since when its gate doesn't let a pod through."""
        self._let: dict[str, tuple[str, str]] = {}
        self._let_since: dict[str, float] = {}
        self._driven: dict[str, float] = {}
        """By workload, when its robot last took a command."""
        self._starving: dict[str, float] = {}
        """By workload, since when its robot is without one although a standby and all else works."""
        self.taken: dict[str, str] = {}
        """By workload, whom its robot takes."""

    # -- gates ------------------------------------------------------------------------------------------------------

    def _named(self, record: gates.GateRecord) -> tuple[str, ...]:
        return (*super()._named(record), *((record.admitted,) if record.admitted else ()))

    def _control(self, gate: Object) -> object:
        return gates.read(gate).active_uid

    def _gate(self, old: Object | None, new: Object) -> None:
        super()._gate(old, new)
        record = gates.read(new)
        workload = new["metadata"]["name"].removesuffix("-gate")
        before = gates.read(old) if old is not None else None
        if record.admitted_uid and record.admitted_uid == record.active_uid:
            self._broken(f"{names.gate(workload)} names {record.active} twice")
        if before is not None and before.active_uid != record.active_uid and record.admitted:
            self._broken(f"the commit of {record.active} lets {record.admitted} through too")
        if record.admitted_uid and (before is None or before.admitted_uid != record.admitted_uid):
            self._admitted(record)
        now = self.robots.now
        let = {uid for uid in (record.active_uid, record.admitted_uid) if uid}
        shut = self._shut_out.setdefault(workload, {})
        for uid in {before.active_uid, before.admitted_uid} - let if before is not None else ():
            shut[uid] = now
        for uid in let:
            shut.pop(uid, None)
        if self._let.get(workload) != (record.active_uid, record.admitted_uid):
            self._let[workload], self._let_since[workload] = (record.active_uid, record.admitted_uid), now
        self.robots.later(ENFORCED + 0.001, self.routed, workload)
        if record.recovery and (before is None or before.epoch != record.epoch):
            self._recovering(workload, record)

    def _recovering(self, workload: str, record: gates.GateRecord) -> None:
        """A recovery has committed: what the reflex did is built upon."""
        taken = Progress.model_validate_json(record.recovery).taken_over
        if taken is None:
            return
        self.robots.seen["fell over"] += taken.uid == record.active_uid
        found = self.robots.running.get(taken.uid)
        if found is None or record.active_uid == taken.uid or not self._works(found):
            return
        watching = [w.reader for w in self.robots.watching[workload] if w.process.alive]
        if all(reader.driver == taken.uid for reader in (self.robots.reader_of(workload), *watching)):
            self._broken(f"{workload} took {taken.name} by the reflex, and its gate names {record.active or 'nobody'}")

    def _admitted(self, record: gates.GateRecord) -> None:
        """A standby is let through: its process is weaker than the one in control, unless that one was restarted just now."""
        active, standby = (self.robots.agents.get(uid) for uid in (record.active_uid, record.admitted_uid))
        self.robots.seen["let through"] += 1
        if active is None or standby is None or active.writer is None or standby.writer is None:
            return
        if active.process == 1 and standby.writer.strength >= active.writer.strength:
            self._broken(f"{record.admitted} is let through beside {record.active}, which is no stronger")

    def shut_out(self, workload: str, uid: str) -> bool:
        """Whether a workload's gate has shut a pod out."""
        return uid in self._shut_out.get(workload, {})

    # -- robots -----------------------------------------------------------------------------------------------------

    def routed(self, robot: str) -> None:
        robots, now = self.robots, self.robots.now
        driver = robots.reader_of(robot).driver
        if driver and driver != self.taken.get(robot):
            found = robots.running[driver]
            robots.noted(f"{robot} takes {found.name}")
            robots.seen["taken"] += 1
        self.taken[robot] = driver
        if not driver:
            return
        found, agent = robots.running[driver], robots.agents[driver]
        shut = self._shut_out.get(robot, {}).get(driver)
        if shut is not None and now - shut > ENFORCED and found.exists and not self._unnoticed(found, shut):
            self._broken(f"{robot} takes {found.name}, which its gate shut out {now - shut:.3f} s ago")
        if agent.gave_way is not None and agent.process > agent.gave_way:
            self._broken(f"{robot} takes a process of {found.name} that started after it gave way")

    def _unnoticed(self, found: Running, shut: float) -> bool:
        """Whether its node may know only an old gate, and nobody could have held the pod: it was cut off so shortly, or before its
        agent was told who may answer, or was let go on before the commit was made or known.
        """
        cut, back = self.robots.cut_at.get(found.node, 0.0), self.robots.back_at.get(found.node, 0.0)
        agent = self.robots.agents[found.uid]
        unheld = back - cut < UNNOTICED or agent.unfenced or agent.believed
        return unheld and back > shut - TOLD_AGAIN and self.robots.now - back < TOLD_AGAIN + ENFORCED

    def look(self) -> None:
        """Now and then: nobody waits in vain for commands."""
        for robot in sorted(self._let):
            self._look(robot)

    def _look(self, robot: str) -> None:
        robots, now = self.robots, self.robots.now
        if robots.reader_of(robot).driver:
            self._driven[robot] = now
            self._starving.pop(robot, None)
            return
        active, admitted = self._let[robot]
        deadline = seconds(robots.reflex.deadline) + PERIOD + ENFORCED + LOOK
        since = max(self._driven.get(robot, now), self._let_since[robot], self._reaches_since(admitted))
        if admitted and now - since > deadline:
            self._broken(f"{robot} takes nobody for {now - since:.3f} s although {admitted} is let through and works")
        working = [r.uid for r in robots.running.values() if r.robot == robot and self._works(r)]
        if self._excused(robot) or not working:
            self._starving.pop(robot, None)
        elif now - self._starving.setdefault(robot, now) > STARVED:
            self._broken(f"{robot} takes nobody for {STARVED} s although {' and '.join(working)} work, and its monitor")

    def _works(self, found: Running) -> bool:
        agent = self.robots.agents.get(found.uid)
        return (
            agent is not None
            and found.sends
            and found.exists
            and agent.writer is not None
            and not agent.hangs
            and not agent.holds
            and not self.robots.cuts.get(found.node)
        )

    def _reaches_since(self, uid: str) -> float:
        agent = self.robots.agents.get(uid)
        return agent.reaches_since or self.robots.now if agent is not None else self.robots.now

    # -- once all is calm -------------------------------------------------------------------------------------------

    def _undriven(self) -> Iterator[str]:
        yield from super()._undriven()
        for robot, (active, _) in sorted(self._let.items()):
            for whose, reader in [("it", self.robots.reader_of(robot))] + [
                (str(w.process), w.reader) for w in self.robots.watching.get(robot, ()) if w.process.alive
            ]:
                if reader.driver != active:
                    yield f"{robot}: {whose} takes {reader.driver or 'nobody'}, and its gate names {active}"

    def unrest(self) -> list[str]:
        return [*super().unrest(), *self._held(), *self._unarmed()]

    def _held(self) -> Iterator[str]:
        for found in self.robots.running.values():
            agent = self.robots.agents.get(found.uid)
            if not found.ended and agent is not None and agent.holds:
                yield f"pod {found.name} is held"

    def _unarmed(self) -> Iterator[str]:
        for robot, (active, admitted) in sorted(self._let.items()):
            waiting = [r for r in self.robots.running.values() if r.robot == robot and r.uid != active and self._works(r)]
            if waiting and not admitted:
                yield f"{robot}: no standby is let through ({self._says(robot)})"


class Reflexive(Simulation):
    """A run with a reflex."""

    causes: Mapping[str, int] = TROUBLES | {
        "active_hangs": 7,
        "standby_hangs": 3,
        "node_is_cut_off": 6,
        "node_is_cut_off_from_some": 3,
        "api_server_is_away": 4,
        "monitor_reaches_nobody": 2,
        "robot_restarts": 1,
        "somebody_asks": 2,
    }

    def __init__(self, *given: Any, **more: Any) -> None:
        self._away = 0
        super().__init__(*given, **more)

    @property
    def mine(self) -> ReflexRobots:
        """The robots."""
        return cast(ReflexRobots, self.robots)

    def _make_robots(self) -> Robots:
        made = ReflexRobots(
            self.loop,
            self.server,
            self.network,
            self.choices,
            self.world,
            folder=self._folder,
            reflex=Reflex(deadline=self.scene.reflex),
        )
        made.told = self._told
        return made

    def _make_invariants(self) -> Invariants:
        return ReflexInvariants(
            self.server,
            self.robots,
            broken=self._broken,
            leads=self._leads,
            excused=self._excused,
            says=self._says,
        )

    def _make_monitor(self, process: Process, workload: str, journal: Path) -> Monitor:
        made = ReflexMonitor(
            process, self.network, self.mine, workload, journal, self.kill, self._broken, initializes=False
        )
        invariants = cast(ReflexInvariants, self.invariants)
        cast(ReflexSidecars, made.sidecars).shut_out = functools.partial(invariants.shut_out, workload)
        return made

    def patches(self) -> Iterator[tuple[Any, str, Any]]:
        yield strengths, "BEGIN", EPOCH - 3600.0
        yield preparing, "time", SimpleNamespace(time=lambda: self.mine.prepared_at)

    def _told(self, robot: str) -> None:
        for monitor in self.monitors:
            if monitor.workload == robot and monitor.process.alive:
                self.loop.call_soon(monitor.sidecars.on_status, context=monitor.process.context)

    def _follow(self, process: Process, work: object) -> None:
        if self._away:
            self.network.cut_off.add(process)
        super()._follow(process, work)

    def _says(self, robot: str) -> str:
        return "; ".join(cast(ReflexMonitor, m).says("Reflex") for m in self.monitors if m.workload == robot)

    def _excused(self, robot: str) -> bool:
        """Whether a robot's monitor can't be expected to see to it."""
        monitors = [m for m in self.monitors if m.workload == robot]
        well = (
            len(monitors) == 1
            and not monitors[0].process.stalled
            and monitors[0].process not in self.network.cut_off
            and robot not in self.mine.apart
            and not self.mine.cuts
            and (self.network.weather == Weather())
        )
        return not well or "NothingVerified" in cast(ReflexMonitor, monitors[0]).says("Recovering")

    def _take_up(self) -> None:
        self.mine.take_up()
        self._look_at_robots()

    def run(self) -> Outcome:
        outcome = super().run()
        outcome.reflex = dict(self.mine.seen)
        return outcome

    def _look_at_robots(self) -> None:
        cast(ReflexInvariants, self.invariants).look()
        self.later(LOOK, self._look_at_robots)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def _standby(self, workload: str) -> str:
        """The standby that is let through, or else any."""
        gate = self.server.get("networkpolicies", (NAMESPACE, names.gate(workload)))
        if gate is not None and (admitted := gates.read(gate).admitted_uid):
            return admitted
        others = [uid for uid, r in self.robots.running.items() if r.robot == workload and uid != self._active(workload)]
        return self.choices.choice(sorted(others)) if others else ""

    def _hang(self, uid: str) -> None:
        found = self.robots.running.get(uid)
        if found is not None:
            lasts = self.choices.choice([0.4, 1.0, 6.0]) * (0.2 + self.choices.random())
            self.note(f"pod {found.name}: stands still for {lasts:.2f} s")
            self.mine.hang(uid, lasts)

    def _active_hangs(self) -> None:
        self._hang(self._active(self.choices.choice(self.workloads)))

    def _standby_hangs(self) -> None:
        self._hang(self._standby(self.choices.choice(self.workloads)))

    def _cut(self, parties: frozenset[str], lasts: float) -> None:
        workload = self.choices.choice(self.workloads)
        uid = self._active(workload) if self.choices.random() < 0.7 else self._standby(workload)
        if (found := self.robots.running.get(uid)) is not None:
            self.mine.cut(found.node, parties)
            self.later(lasts, self.mine.join, found.node)

    def _node_is_cut_off(self) -> None:
        self._cut(EVERYBODY, self.choices.choice([0.5, 2.0, 8.0]) * (0.2 + self.choices.random()))

    def _node_is_cut_off_from_some(self) -> None:
        self._cut(self.choices.choice(SOME), 6 * self.choices.random())

    def _api_server_is_away(self) -> None:
        """It refuses everything, or nothing arrives there; and mostly something else happens meanwhile."""
        lasts = 0.5 + 9 * self.choices.random()
        self.choices.choice([self._refuses, self._is_away])(lasts)
        meanwhile = [self._one_fails, self._active_hangs, self._node_is_cut_off, self._standby_hangs, self._monitor_dies]
        for _ in range(self.choices.randint(0, 2)):
            self.later(lasts * self.choices.random(), self.choices.choice(meanwhile))

    def _refuses(self, lasts: float) -> None:
        self.note(f"the API server refuses everything for {lasts:.1f} s")
        weather, self.network.weather = self.network.weather, Weather(refused=1.0)
        self.later(lasts, self._is_back, weather)

    def _is_away(self, lasts: float) -> None:
        self.note(f"nobody reaches the API server for {lasts:.1f} s")
        self._away += 1
        self.network.cut_off |= {actor.process for actor in (*self.monitors, *self.operators)}
        self.later(lasts, self._is_reached)

    def _is_back(self, weather: Weather) -> None:
        if not self._calm:
            self.network.weather = weather

    def _is_reached(self) -> None:
        self._away = max(0, self._away - 1)
        if not self._away:
            self.network.cut_off.clear()

    def _monitor_reaches_nobody(self) -> None:
        workload, lasts = self.choices.choice(self.workloads), 6 * self.choices.random()
        self.note(f"the monitors of {workload} reach nobody for {lasts:.1f} s")
        self._set_apart(workload, True)
        self.later(lasts, self._set_apart, workload, False)

    def _set_apart(self, workload: str, so: bool) -> None:
        processes = {monitor.process for monitor in self.monitors if monitor.workload == workload}
        if so:
            self.mine.apart.add(workload)
            self.network.cut_off |= processes
        else:
            self.mine.apart.discard(workload)
            self.network.cut_off -= processes
        self.mine._route(workload)
        self._told(workload)

    def _robot_restarts(self) -> None:
        workload = self.choices.choice(self.workloads)
        self.note(f"{workload}: the robot's own process is restarted")
        del self.mine.readers[workload]
        self.mine._route(workload)

    def _end_of_trouble(self) -> None:
        self._away = 0
        for node in sorted(self.mine.cuts):
            self.mine.join(node)
        for workload in sorted(self.mine.apart):
            self._set_apart(workload, False)
        super()._end_of_trouble()


def run(
    seed: int, *, tracing: bool = False, scene: Scene | None = None, kind: type[Reflexive] = Reflexive
) -> Outcome:
    """The run of a seed. What doesn't hold is in its outcome; with ``tracing`` it also tells all that happened."""
    scene = scene or SCENES[seed % len(SCENES)]
    base = simulation.prepared(scene, Reflexive)
    with tempfile.TemporaryDirectory() as folder:
        made = kind(scene, seed, base, Path(folder), tracing=tracing)
        try:
            return made.run()
        finally:
            made.dispose()
