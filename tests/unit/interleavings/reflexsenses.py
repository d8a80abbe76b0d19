"""What a monitor knows of a robot with a reflex: what its own reader takes, and what the agents of instances say that it reaches."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from tests.unit.interleavings.actors import Monitor
from tests.unit.interleavings.ownership import PERIOD, Reader
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.reflexrobots import ReflexRobots
from tests.unit.interleavings.scheduling import Process
from tests.unit.interleavings.senses import GAP, AgentConnections, HealthObserver, Outputs, Probes
from understudy.agent.control_channel import Peer
from understudy.api.protocol.agent_messages import SILENCE, AgentStatus
from understudy.failover.interfaces import Instance
from understudy.kube.agent_client import AgentGone
from understudy.monitor.act.gate.permits import Permits
from understudy.monitor.loop import MonitorLoop, Parts
from understudy.monitor.observe.agent_connections import ANSWER_LATE
from understudy.monitor.observe.robot.known_senders import KnownSender, OutputSender
from understudy.ros.runtime.graph_node import Endpoint, Graph


class ReflexSight(HealthObserver):
    """What a monitor's reader takes."""

    def __init__(
        self,
        process: Process,
        robots: ReflexRobots,
        workload: str,
        looked: Callable[[], None],
        reader: Reader,
    ) -> None:
        super().__init__(process, robots, workload, looked)
        self._reader = reader

    def _named(self, name: str) -> Running | None:
        found = [r for r in self._robots.running.values() if r.name == name and r.robot == self._workload]
        return found[-1] if found else None

    def known_senders(self) -> Sequence[KnownSender]:
        return ()

    def output_senders(self) -> Sequence[OutputSender]:
        return ()

    def _last(self, found: Running | None) -> float | None:
        return self._reader.last(found.uid) if found is not None else None

    def arrivals(self, topic: str, pod: str) -> list[float]:
        found = self._named(pod)
        return self._reader.arrivals(found.uid) if found is not None else []

    def ambiguous(self, pod: str) -> bool:
        return False

    def outputs(self, fleet: Any, gate: Any) -> Outputs:
        return ReflexOutputs(self, self._reader, fleet, gate)


class ReflexOutputs(Outputs):
    """What the failover protocol sees of it."""

    def __init__(self, observer: ReflexSight, reader: Reader, fleet: Any, gate: Any) -> None:
        super().__init__(observer, observer._robots, observer._workload, fleet, gate)
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

    def period_of_others(self, instance: Instance) -> float:
        return 0.0


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

    def heard_since(self, time: float) -> Sequence[str]:
        return ()


class ReflexSidecars(AgentConnections):
    """Agents that report the strengths of their instances, and receive the list of those who may permit them to continue."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._statuses: dict[str, tuple[AgentStatus, float]] = {}
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
            state, at = self._statuses.get(instance.uid, (None, 0.0))
            return state if robots.now - at < SILENCE else None
        if status is not None and agent is not None:
            # Only with the policy's gap is silence noticed.
            works = (found.sends and not agent.hangs) or robots.now - agent.silent_since < GAP
            strength = agent.strengths.range if agent.process else None
            status = replace(status, ready=works and not agent.holds, strength=strength, cut_off=agent.isolation.since)
        if status is not None:
            self._statuses[instance.uid] = (status, robots.now)
        return status

    def session(self, instance: Instance) -> tuple[int, int]:
        agent = self._world.agents.get(instance.uid)
        return (0, 0) if agent is None else (1, agent.sessions.number)

    async def renew_permit(self, instance: Instance, body: Mapping[str, Any]) -> None:
        agent = self._world.agents.get(instance.uid)
        if agent is None or self._found(instance) is None:
            await asyncio.sleep(ANSWER_LATE)
            raise AgentGone(f"{instance.name}: its agent is not connected")
        if body.get("word") == "Go":
            agent.believed = self.believed(instance.uid) or not self.shut_out(instance.uid)
        await asyncio.sleep(self._robots.network.delay())
        await agent.isolation.renew(body, Peer(self._workload, instance.claim, self._workload))

    async def give_way(self, instance: Instance) -> None:
        agent = self._world.agents.get(instance.uid)
        if agent is not None and self._found(instance) is not None:
            self._robots.later(self._robots.network.delay(), agent.give_way)


class NoReaders:
    """A graph in which nobody reads: the robot is known by its address."""

    def subscribers(self, topic: str) -> tuple[Endpoint, ...]:
        return ()


class ReflexMonitor(Monitor):
    """One whose reader is like the robot's."""

    def __init__(
        self, process: Process, network: Any, robots: ReflexRobots, workload: str, *rest: Any, **more: Any
    ) -> None:
        self.reader = robots.watch(process, workload)
        super().__init__(process, network, robots, workload, *rest, **more)
        self.agents = ReflexSidecars(self._robots, self.workload, self.fuse.step, initializes=False)

    def _make_agents(self, *_: Any) -> Any:
        return self.agents

    def _make_observer(self) -> HealthObserver:
        return ReflexSight(
            self.process, cast(ReflexRobots, self._robots), self.workload, self._look_at_gate, self.reader
        )

    def _make_probes(self) -> Probes:
        return ReflexProbes(self.process, self._robots, self.workload)

    def _beside(self, loop: MonitorLoop, parts: Parts, group: asyncio.TaskGroup) -> None:
        graph = cast(Graph, NoReaders())
        permits = Permits(parts.cluster, parts.senses.agents, graph, self.current, self.wakeups, parts.notices)

        def believed(uid: str) -> bool:
            state, recovering = parts.cluster.gate.state, self.current.progress
            lost = recovering is not None and recovering.taken_over is not None and recovering.has_failed(uid)
            return uid in (state.active_uid, state.admitted_uid) and not lost

        self.agents.believed = believed

        group.create_task(permits.run())

    def says(self, condition: str) -> str:
        """Why it says that a condition is as it is."""
        conditions = self.notices.status.to_wire()["conditions"] if self.notices is not None else []
        return next((f"{c['reason']}: {c['message']}" for c in conditions if c["type"] == condition), "")
