"""The agent of each pod. Its control channel, its rules, its readiness of standbys and its procedures are the real ones; the
application that they look at is the model's.
"""

from __future__ import annotations

import asyncio
import base64
import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, cast

from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.scheduling import Process
from understudy.agent.agent_memory import AgentMemory
from understudy.agent.control_channel import ControlChannel, Operation, Peer, Refused
from understudy.agent.readiness import StandbyExpectation, StandbyReadiness
from understudy.agent.restoration.procedure_runner import InstanceActions, ProcedureRunner
from understudy.api import names
from understudy.api.protocol.agent_messages import BEGUN, AgentStatus, GateEpoch
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.api.protocol.secure_channel import AgentSecret

if TYPE_CHECKING:
    from tests.unit.interleavings.robots import Robots

NOTICES = 0.5
"""Seconds of silence after which an agent says that its application is not healthy."""

READS = ("goals",)
"""Operations that change nothing in an instance: they may be of an old epoch."""

FAILS_WITHIN = 0.5
"""Seconds after which a procedure that fails early has failed, at most."""


class Actions:
    """What the steps of a procedure find in a pod."""

    def __init__(self, robots: Robots, found: Running) -> None:
        choices = robots.choices
        self.report = RestoreReport()
        self._robots, self._found, self._fails = robots, found, choices.random() < robots.luck.failing
        found.harmed |= self._fails
        self._error = choices.random() < 0.5
        self._there_at = robots.loop.time() + 0.05 + 0.1 * choices.random()

    async def node_present(self, node: str) -> bool:
        """Whether a node is there: a moment after the procedure has begun."""
        there = self._robots.loop.time() >= self._there_at
        if there and self._fails and self._error:
            raise RuntimeError("the node has crashed")
        return there and not self._fails and not self._found.frozen


class PodAgent:
    """Implements :class:`understudy.agent.control_channel.AgentInterface`."""

    def __init__(self, robots: Robots, found: Running, process: Process) -> None:
        self.process, self._robots, self._found = process, robots, found
        self.channel = ControlChannel(self)
        self._goals = robots.goals(found, self.channel.publish)
        self._healthy = found.sends
        self._version = 0
        self._changed = asyncio.Event()
        self._readiness = StandbyReadiness(self._actions, lambda purpose, topics: None, self.notify)
        self._procedures = ProcedureRunner(
            lambda state: self._actions(),
            lambda purpose, topics: None,
            on_begin=self._procedure_begins,
            on_success=self._procedure_done,
            on_end=self._procedure_ends,
        )

    @property
    def memory(self) -> AgentMemory:
        """What outlives the agent, as it lies in the pod's volume."""
        return self._found.memory

    def _actions(self, *_: Any) -> InstanceActions:
        if self.held:
            raise Refused("nobody has claimed the pod")
        return cast(InstanceActions, Actions(self._robots, self._found))

    async def run(self) -> None:
        """Serve monitors."""
        with_standby = self.memory.standby
        if with_standby is not None:
            self._readiness.expect(StandbyExpectation.from_wire(with_standby))
        await self.channel.serve(host=self._found.ip)

    # -- what a monitor sees ----------------------------------------------------------------------------------------

    @property
    def uid(self) -> str:
        return self._found.uid

    def secret(self) -> AgentSecret:
        """As the kubelet has mounted it."""
        namespace = self._found.place[0]
        secret = self._robots.server.get("secrets", (namespace, self._found.secret))
        if secret is None:
            raise FileNotFoundError(2, "no such secret")
        token, key = (secret["data"].get(entry, "") for entry in (names.TOKEN, names.MONITOR_PUBLIC_KEY))
        return AgentSecret(base64.b64decode(token), base64.b64decode(key))

    def refuses(self, workload: str, claim: str) -> str | None:
        return self.memory.refuses(self._found.name, self._found.owner, workload, claim)

    def outdated(self, epoch: GateEpoch) -> str | None:
        if self.held:
            return None
        reason = self.memory.outdated(epoch)
        if reason is None:
            self.memory.learn(epoch)
        return reason

    @property
    def held(self) -> bool:
        """Whether its processes wait for a claim."""
        return self._found.held

    def status(self) -> AgentStatus:
        found, memory = self._found, self.memory
        configured = memory.configuration is not None
        if self.held:
            return AgentStatus("Held", True, configured=configured)
        if found.sends and memory.ready_at is None:
            memory.ready_at = found.sends_since
        reason = "" if self._healthy else "its outputs are not healthy"
        ready, reason = self._readiness.judge(
            self._healthy, reason, brought=memory.brought, busy=self._procedures.summary
        )
        return AgentStatus(
            phase="Running" if memory.ready_at is not None else "Starting",
            ready=ready,
            reason=reason,
            process_up_at=found.up_at,
            ready_at=memory.ready_at,
            configured=configured,
            initialized=memory.brought,
            procedure=self._procedures.doing,
            gate=GateEpoch(memory.workload_uid, memory.epoch),
        )

    @property
    def version(self) -> int:
        return self._version

    async def changed(self, version: int) -> None:
        while self._version <= version:
            await self._changed.wait()

    def notify(self) -> None:
        """Say how its instance is."""
        self._version += 1
        self._changed.set()
        self._changed = asyncio.Event()

    def look(self) -> None:
        """See how its application is. That it is silent is known after a while."""
        if self._found.sends != self._healthy:
            if self._found.sends or self._robots.now - self._found.silent_since >= NOTICES:
                self._healthy = self._found.sends
            else:
                self._robots.look_later(self._found.uid, NOTICES)
        self.notify()

    # -- what a monitor commands ------------------------------------------------------------------------------------

    def operations(self) -> Mapping[str, Operation]:
        own: dict[str, Operation] = {
            "configure": self._configure,
            "start": self._start,
            "probe": self._ignore,
            "give_way": self._ignore,
            "restore": self._restore,
        }
        found = {**own, **self._procedures.operations(), **(self._goals.operations() if self._goals else {})}
        return {name: self._seen(name, operation) for name, operation in found.items()}

    def _seen(self, name: str, operation: Operation) -> Operation:
        async def carry_out(body: Mapping[str, Any], peer: Peer) -> Mapping[str, Any] | None:
            if name not in READS:
                self._robots.commanded(self._found, name, GateEpoch.from_wire(body.get("gate")), peer.host)
            return await operation(body, peer)

        return carry_out

    async def _ignore(self, body: Mapping[str, Any], peer: Peer) -> None:
        return

    async def _restore(self, body: Mapping[str, Any], peer: Peer) -> Mapping[str, Any]:
        self._robots.restored(self._found, KeptState.from_wire(body.get("state") or {}))
        return {"report": RestoreReport().to_wire()}

    async def _configure(self, body: Mapping[str, Any], peer: Peer) -> None:
        memory = self.memory
        memory.configuration = {key: body.get(key) for key in ("tree", "outputs", "grace")}
        if (standby := body.get("standby")) != memory.standby:
            self._readiness.expect(StandbyExpectation.from_wire(standby))
            memory.standby = standby
        self.notify()

    async def _start(self, body: Mapping[str, Any], peer: Peer) -> None:
        memory, epoch = self.memory, GateEpoch.from_wire(body.get("gate"))
        if not memory.workload and not self.held:
            raise Refused("its processes started with the pod")
        if not memory.workload:
            bound = {"workload": peer.workload, "claim": peer.claim}
            self._found.memory = dataclasses.replace(
                memory, epoch=epoch.number, workload_uid=epoch.workload_uid, **bound
            )
            self._robots.started(peer.workload, self._found)
        self._robots.start(self._found.uid, peer.workload)
        self.notify()

    # -- procedures -------------------------------------------------------------------------------------------------

    def _procedure_begins(self, name: str, brought: str) -> None:
        if brought:
            self.memory.brought = f"{BEGUN}{brought}"
            self._robots.disturb(self._found.uid)
        self.notify()

    def _procedure_done(self, name: str, brought: str) -> None:
        if brought:
            self.memory.brought = brought
            self._robots.bring(self._found.uid, brought)

    def _procedure_ends(self) -> None:
        self._robots.calm(self._found.uid)
        self.notify()


Publish = Callable[[Mapping[str, Any]], None]
"""Sends an event to all sessions of an agent."""

Commanded = Callable[[Running, str, GateEpoch, str], None]
"""Called with each command that an agent carries out: the instance, the operation, its epoch, and who has sent it."""
