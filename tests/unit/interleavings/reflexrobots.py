"""Robots whose readers fall over by themselves, and nodes that can be cut off: from everybody, or from some.

A node enforces the gate that it received last, and receives the present one some time after it is connected again. Strengths
and fences are the agents' own code (agents.py); readers are a model (ownership.py).
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.unit.interleavings import gates
from tests.unit.interleavings.agents import Agent, Questions, Sessions
from tests.unit.interleavings.apiserver import Place
from tests.unit.interleavings.ownership import Reader, Writer
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import NODES, Robots
from tests.unit.interleavings.scenes import ROBOTS
from tests.unit.interleavings.scheduling import Process
from understudy.agent.isolation import Isolation
from understudy.agent.writer_strength import WriterStrengths
from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import Reflex
from understudy.ros.dds import exclusive_ownership

ADDRESS = ROBOTS.partition("/")[0]
"""Of the robots."""

EVERYBODY = frozenset({"robot", "monitor", "nodes", "API server"})
"""Whom a node can be cut off from."""

TOLD_AGAIN = 0.5
"""Most seconds after which a node that was cut off knows the gates again."""

DISCOVERY = 1.0
"""Most seconds until a new reader has discovered a writer."""

SKEW = 0.2
"""Largest difference of the nodes' clocks, in seconds."""


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
    agent_reported: Callable[[str], None] = lambda robot: None
    """Called when an agent of a robot's instances has something to say."""
    counts: Counter[str] = field(default_factory=Counter)
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
                    self.agents[found.uid].see_writers()
        for robot in self.let_through:
            for node in NODES:
                self._enforced[node, robot] = self.let_through[robot]
            self.route(robot)

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
        self.route(robot)
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
        if host == ADDRESS:
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
        self.reroute()

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
        self.reroute()
        for found in [r for r in self.running.values() if r.node == node]:
            self.agent_reported(found.robot)

    def _ask(self, found: Running) -> None:
        """Its agent's fence has something to do. Until now everybody has answered it."""
        agent = self.agents.get(found.uid)
        if agent is None or agent.asking:
            return
        agent.unfenced = agent.isolation.monitor is None
        if agent.unfenced:
            return
        agent.asking = True
        agent.isolation.permit.answered(self.loop.time())
        task = self.loop.start(self.process, agent.isolation.run())

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
            self.counts["held"] += 1
        self.noted(f"pod {found.name}: {self.agents[uid].isolation.reason or 'goes on'}")
        self.route(found.robot)
        self.agent_reported(found.robot)

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
        isolation = Isolation(
            folder,
            ("app",),
            on_change=functools.partial(self._changed, found.uid),
            attempts=functools.partial(Questions, functools.partial(self._answers, found.uid)),
        )
        isolation.contacts = sessions
        strengths = WriterStrengths(folder, clock=functools.partial(self.clock, found.node))
        agent = Agent(found.uid, folder, strengths, isolation, sessions, self.choices.random)
        agent.prepare(f"<profile>{exclusive_ownership.instance_writer(self.reflex)}</profile>")
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

    def _end(self, uid: str, *, begun: bool = False) -> None:
        if self._away(uid, self._end, uid):
            return
        if uid in self.agents:
            self.agents[uid].left = True
        super()._end(uid, begun=begun)

    def _send(self, uid: str) -> None:
        found, agent = self.running.get(uid), self.agents.get(uid)
        if found is not None and agent is not None and not (found.ended or found.broken or found.sends):
            if agent.holds:  # the script waits before it starts its command
                self.later(0.5, self._send, uid)
                return
            agent.begin()
            self.later(self.between(0.05, 0.3), self._see_writers, uid, agent.process)
        super()._send(uid)

    def _see_writers(self, uid: str, process: int) -> None:
        agent = self.agents[uid]
        if agent.process == process and not self.running[uid].ended:
            agent.see_writers()
            self.agent_reported(self.running[uid].robot)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def freeze(self, uid: str) -> None:
        if uid in self.agents:
            self.agents[uid].silent_since = self.now
        super().freeze(uid)

    def pause(self, uid: str) -> None:
        self.hang(uid, self.between(0.6, 6.0))

    def slow_down(self, uid: str) -> None:
        return  # a reader with a deadline takes it for silent

    def crash(self, uid: str) -> None:
        if (agent := self.agents.get(uid)) is not None:
            if agent.strengths.range is not None:
                agent.see_writers()  # until now
            agent.silent_since, agent.hangs = 0.0, False
        super().crash(uid)

    def hang(self, uid: str, seconds: float) -> None:
        """An application stands still for a while."""
        agent = self.agents.get(uid)
        if agent is None or agent.hangs:
            return
        agent.hangs, agent.silent_since = True, self.now
        self.route(self.running[uid].robot)
        self.later(seconds, self.thaw, uid, agent.process)

    def thaw(self, uid: str, process: int) -> None:
        """It goes on as if nothing had been."""
        agent = self.agents[uid]
        if agent.hangs and agent.process == process:
            self.noted(f"pod {self.running[uid].name}: thaws")
            agent.hangs = False
            self.route(self.running[uid].robot)
            self.agent_reported(self.running[uid].robot)

    # -- what reaches the robots ------------------------------------------------------------------------------------

    def _enforce(self, workload: str) -> None:
        super()._enforce(workload)
        for node in NODES:
            self.later(self.between(0.0, 0.02), self._enforce_at, node, workload)

    def _enforce_at(self, node: str, workload: str) -> None:
        if self.reaches(node, "API server") and node not in self._stale:
            policy = gates.find(self.server, workload)
            self._enforced[node, workload] = gates.let_through(policy) if policy is not None else ()
            self.route(workload)

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
            source = writer if self.reaches(found.node, "monitor", robot) else None
            for watching in self.watching.get(robot, ()):
                known = source is not None and self._discovered(watching, source, robot)
                watching.reader.hear(found.uid, source if known else None, left=agent.left)

    def _discovered(self, watching: Watching, writer: Writer, robot: str) -> bool:
        if writer not in watching.known:
            new = self.now - watching.since < DISCOVERY
            watching.known[writer] = self.now + (self.between(0.0, DISCOVERY) if new else 0.0)
            if new:
                self.later(watching.known[writer] - self.now, self.route, robot)
        return watching.known[writer] <= self.now
