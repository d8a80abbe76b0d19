"""The agent of one pod. It decides which monitor may command it, and stores the phase of its instance."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from understudy.agent import isolation, prepare
from understudy.agent.agent_memory import AgentMemory
from understudy.agent.control_channel import Operation, Peer, Refused
from understudy.agent.held_containers import HeldContainers
from understudy.agent.instance_health import HealthPlan, InstanceHealth
from understudy.agent.network_interfaces import FurtherInterfaces
from understudy.agent.pod_identity import PodIdentity
from understudy.agent.readiness import StandbyExpectation, StandbyReadiness
from understudy.agent.restoration.procedure_runner import InstanceActions, ProcedureRunner
from understudy.agent.restoration.state_restoration import StateRestorer
from understudy.agent.restoration.task_goals import TaskGoals
from understudy.agent.writer_strength import WriterStrengths
from understudy.api import names
from understudy.api.protocol import hold_script
from understudy.api.protocol.agent_messages import BEGUN, AgentStatus, GateEpoch, Phase
from understudy.api.protocol.kept_state import KeptState
from understudy.api.protocol.secure_channel import AgentSecret
from understudy.clock import CLOCK
from understudy.kube.gates.probes import ProbeSender
from understudy.ros.rmw import MIDDLEWARE

if TYPE_CHECKING:
    from understudy.ros.actions.instance_calls import InstanceCaller

_logger = logging.getLogger(__name__)


class Agent:
    """Implements :class:`understudy.agent.control_channel.AgentInterface`."""

    def __init__(self, identity: PodIdentity, probes: ProbeSender) -> None:
        """Continue where an earlier agent of this pod stopped. Raises OSError when a volume cannot be used."""
        self._identity, self._probes = identity, probes
        self._holds = HeldContainers(identity.directory, identity.held)
        self._holds.prepare()
        self._memory = AgentMemory.load(identity.memory)
        self._strengths = WriterStrengths(identity.directory, memory=identity.memory)
        self._interfaces = FurtherInterfaces(identity.ip)
        self.isolation = isolation.Isolation(
            identity.directory,
            identity.fenced or isolation.built(identity.directory, identity.held),
            unfenced=identity.unfenced,
            apiserver=isolation.apiserver(os.environ),
            on_change=self._notify,
            nudge=self._notify,
        )
        """Freezes the application while the pod is isolated."""
        self._health = InstanceHealth(identity.pod, on_change=self._health_changed, on_writers=self._writers_seen)
        self._health.resume(self._memory.process_up_at, self._memory.ready_at)
        self._caller: InstanceCaller | None = None
        self._restorer = StateRestorer(lambda: self.caller)
        name = "understudy_goals_" + names.in_ros(identity.pod)
        self._goals = TaskGoals(name, self._health.place, lambda event: self.publish(event))
        self._procedures = ProcedureRunner(
            self._actions,
            self._health.watch,
            on_begin=self._procedure_begins,
            on_success=self._procedure_done,
            on_end=self._notify,
        )
        self._readiness = StandbyReadiness(lambda: self._actions(KeptState()), self._health.watch, self._notify)
        self.publish: Callable[[Mapping[str, Any]], None] = lambda event: None
        """Sends an event to every connected monitor."""
        self._configuring = asyncio.Lock()
        self._health_task: asyncio.Task[None] | None = None
        self._version = 0
        self._changed = asyncio.Event()

    async def begin(self) -> None:
        """Continue earlier work: finish a start that was interrupted, and evaluate the last tree.

        Raises OSError if a volume cannot be used; a restart of the container tries again.
        """
        if self._memory.configuration is not None:
            try:
                self._health.configure(await asyncio.to_thread(HealthPlan.of, self._memory.configuration))
            except ValueError as error:
                _logger.error("the health tree that an earlier agent stored is invalid and is ignored: %s", error)
                self._memory.configuration = None
        try:
            self._expect(self._memory.standby)
        except Refused as error:
            _logger.error(
                "the readiness check of a standby that an earlier agent stored is invalid and is ignored: %s", error
            )
            self._memory.standby = None
        if self._memory.workload and self._identity.held:
            self._holds.start(self._memory.variables(self._identity.held))
            self._start_health()
        elif not self._identity.held:
            if self._memory.started_at is None:
                self._memory.started_at = CLOCK.now()
                self._save()
            self._start_health()

    async def end(self) -> None:
        """Stop evaluating the instance."""
        await self._readiness.end()
        await self._goals.close()
        if self._caller is not None:
            self._caller.close()
        if self._health_task is not None:
            self._health_task.cancel()
            await asyncio.wait([self._health_task])

    # -- what a monitor sees ----------------------------------------------------------------------------------------

    @property
    def uid(self) -> str:
        """The UID of the pod."""
        return self._identity.uid

    def secret(self) -> AgentSecret:
        """Return the token, and the monitor's key. Raises OSError."""
        return self._identity.secret()

    def refuses(self, workload: str, claim: str) -> str | None:
        """Return why a monitor may not command this pod; None if it may."""
        return self._memory.refuses(self._identity.pod, self._identity.workload, workload, claim)

    def outdated(self, epoch: GateEpoch) -> str | None:
        """Why a request of this epoch may not be carried out; None if it may. Remembers the newest epoch.

        A pod that nobody has claimed has no epoch yet: the requests of all workloads count until one claims it.
        """
        if self.held:
            return None
        reason = self._memory.outdated(epoch)
        if reason is None and self._memory.learn(epoch):
            self._save()
        return reason

    def status(self) -> AgentStatus:
        """Return the state of the instance."""
        judgement, configured = self._health.judgement, self._memory.configuration is not None
        if self.held:
            missing = self._holds.missing()
            reason = f"not waiting (yet): {', '.join(missing)}" if missing else ""
            return AgentStatus("Held", not missing, reason, configured=configured)
        phase: Phase = "Running" if judgement.ready_at is not None else "Starting"
        brought, doing = self._memory.brought, self._procedures.doing
        ready, reason = self._readiness.judge(
            judgement.ready, judgement.reason, brought=brought, busy=self._procedures.summary
        )
        if self.isolation.reason:
            ready, reason = False, self.isolation.reason
        return AgentStatus(
            phase=phase,
            ready=ready,
            reason=reason,
            started_at=_reported(self._memory.started_at),
            process_up_at=_reported(judgement.process_up_at),
            ready_at=_reported(judgement.ready_at),
            configured=configured,
            outputs=dict(judgement.outputs),
            initialized=brought,
            check=self._readiness.reason,
            procedure=doing,
            strength=self._strengths.range,
            cut_off=self.isolation.since,
            unfenced=self.isolation.unfenced,
            further_interfaces=self._interfaces.seen(time.monotonic()),
            gate=GateEpoch(self._memory.workload_uid, self._memory.epoch),
        )

    @property
    def held(self) -> bool:
        """Whether a container waits for its claim."""
        return bool(self._identity.held) and not self._memory.workload

    @property
    def version(self) -> int:
        """Grows with every change of the status."""
        return self._version

    async def changed(self, version: int) -> None:
        """Wait until the status is newer than this version."""
        while self._version <= version:
            await self._changed.wait()

    # -- what a monitor commands ------------------------------------------------------------------------------------

    def operations(self) -> Mapping[str, Operation]:
        """Return the operations that a monitor can request."""
        own: dict[str, Operation] = {"configure": self.configure, "start": self.start, "probe": self.probe}
        own["give_way"] = self.give_way
        return {
            **own,
            **self._restorer.operations(),
            **self._procedures.operations(),
            **self._goals.operations(),
            **self.isolation.operations(),
        }

    async def configure(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Accept a health tree, and the address that probes go to. Repeating the same request changes nothing.

        Raises Refused.
        """
        configuration = {key: body.get(key) for key in ("tree", "outputs", "grace")}
        if "form" in body:
            configuration["form"] = body["form"]
        if body.get("managed"):
            configuration["managed"] = True
        async with self._configuring:
            if configuration != self._memory.configuration:
                try:
                    plan = await asyncio.to_thread(HealthPlan.of, configuration)
                except ValueError as error:
                    raise Refused(str(error)) from error
                self._health.configure(plan)
                self._memory.configuration = configuration
                self._save()
                self._notify()
            if (standby := body.get("standby")) != self._memory.standby:
                self._expect(standby)
                self._memory.standby = standby
                self._save()
                self._notify()
        probe = body.get("probe") or {"host": peer.host, "port": names.PROBE_PORT}
        self._aim(probe, peer)

    async def start(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Start the held containers, and bind the pod to the workload that requested it. Can be repeated.

        Raises Refused.
        """
        if not self._identity.held:
            raise Refused(f"the containers of pod {self._identity.pod} are not held: they started with the pod")
        if not self._memory.workload:
            self._memory = self._bound(body, peer)
            _logger.info("claimed by %s (%s)", peer.workload, peer.claim)
        try:
            self._holds.start(self._memory.variables(self._identity.held))
        except OSError as error:
            raise Refused(f"cannot start the held containers: {error}") from error
        self._notify()
        self._start_health()

    def _bound(self, body: Mapping[str, Any], peer: Peer) -> AgentMemory:
        """Return the memory of an agent whose pod is bound to the workload that starts it.

        It is stored before the first process starts, so that no later agent of this pod can bind the pod to another
        workload.
        """
        environment, ros = body.get("environment", {}), body.get("ros", {})
        if not _is_environment(ros) or not isinstance(environment, dict):
            raise Refused("environment is a mapping of containers to variables, ros one of variables")
        for container, variables in environment.items():
            if not _is_environment(variables):
                raise Refused(f"environment of {container}: expected a mapping of variables to texts")
        ros = _of_graph(ros)
        profiles = body.get("profiles") or ""
        if not isinstance(profiles, str):
            raise Refused(f"profiles: expected a text, not {type(profiles).__name__}")
        if profiles:
            try:
                file = prepare.write(profiles, self._identity.directory, self._identity.pod)
            except OSError as error:
                raise Refused(f"cannot write the profiles: {error}") from error
            ros = {**ros, MIDDLEWARE.settings_variable: str(file)}
        if names.STRENGTH_VARIABLE in profiles:
            try:
                self.isolation.build(self._identity.held)
            except OSError as error:
                raise Refused(f"cannot create the FIFOs that freeze the application: {error}") from error
        epoch = GateEpoch.from_wire(body.get("gate"))
        bound = dataclasses.replace(
            self._memory,
            epoch=epoch.number,
            workload_uid=epoch.workload_uid,
            workload=peer.workload,
            claim=peer.claim,
            environment=environment,
            ros=ros,
            started_at=CLOCK.now(),
        )
        try:
            for variables in bound.variables(self._identity.held).values():
                hold_script.env_file(variables)
            bound.save(self._identity.memory)
        except (ValueError, OSError) as error:
            raise Refused(str(error)) from error
        return bound

    async def give_way(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Prevent restarted containers of this pod from reaching the robot, because another instance is active.

        Raises Refused.
        """
        try:
            self._strengths.give_way()
        except OSError as error:
            raise Refused(str(error)) from error

    async def probe(self, body: Mapping[str, Any], peer: Peer) -> None:
        """Send gate probes for a limited time. Raises Refused."""
        self._aim({"host": body.get("host") or peer.host, "port": body.get("port", names.PROBE_PORT)}, peer)
        try:
            self._probes.burst(float(body.get("interval", 0.001)), float(body.get("duration", 1.0)))
        except (TypeError, ValueError) as error:
            raise Refused(str(error)) from error

    # -- procedures -------------------------------------------------------------------------------------------------

    @property
    def caller(self) -> InstanceCaller:
        """The calls to this pod's instance. ROS is imported at the first use."""
        if self._caller is None:
            from understudy.ros.actions.instance_calls import InstanceCaller

            name = "understudy_calls_" + names.in_ros(self._identity.pod)
            self._caller = InstanceCaller(name, place=self._health.place)
        return self._caller

    def _actions(self, state: KeptState) -> InstanceActions:
        if self.held:
            raise Refused(f"the containers of pod {self._identity.pod} are held: no workload has claimed it yet")
        return InstanceActions(self.caller, self._health, self._restorer.restore, self._goals.resend, state)

    def _expect(self, standby: object) -> None:
        """Evaluate the readiness of a waiting instance by this expectation. Raises Refused."""
        try:
            self._readiness.expect(StandbyExpectation.from_wire(standby))
        except ValueError as error:
            raise Refused(str(error)) from error

    def _procedure_begins(self, name: str, brought: str) -> None:
        """Forget which procedure the instance completed, because another one is about to change the instance."""
        if brought:
            self._memory.brought = f"{BEGUN}{brought}"
            self._save()
        self._notify()

    def _procedure_done(self, name: str, brought: str) -> None:
        if brought:
            self._memory.brought = brought
            self._save()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _aim(self, probe: object, peer: Peer) -> None:
        try:
            if not isinstance(probe, dict):
                raise TypeError(f"probe is a mapping of host and port, not {probe!r}")
            self._probes.aim(str(probe.get("host")), int(probe.get("port", names.PROBE_PORT)), key=peer.probe_key)
        except (TypeError, ValueError) as error:
            raise Refused(str(error)) from error

    def _start_health(self) -> None:
        """Evaluate the instance from now on, as part of its robot's graph."""
        if self._health_task is None:
            _enter(self._memory.ros)
            self._health_task = asyncio.create_task(self._health.run(), name="health")

    def _health_changed(self) -> None:
        judgement, memory = self._health.judgement, self._memory
        if (judgement.process_up_at, judgement.ready_at) != (memory.process_up_at, memory.ready_at):
            memory.process_up_at, memory.ready_at = judgement.process_up_at, judgement.ready_at
            self._save()
        self._notify()

    def _writers_seen(self, gids: Iterable[bytes]) -> None:
        if self._strengths.saw(gids):
            self._notify()

    def _save(self) -> None:
        """Store the memory. A full volume must not end an agent."""
        try:
            self._memory.save(self._identity.memory)
        except OSError as error:
            _logger.error(
                "could not write the agent's state to %s, so it is lost if the agent restarts: %s",
                self._identity.memory,
                error,
            )

    def _notify(self) -> None:
        self._version += 1
        self._changed.set()
        self._changed = asyncio.Event()


def _is_environment(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values())


def _of_graph(ros: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that describe a robot's ROS graph.

    Others are left out: this process gets them too, and for example LD_LIBRARY_PATH decides which libraries the
    middleware loads.
    """
    if others := sorted(ros.keys() - MIDDLEWARE.variables):
        _logger.warning("left out of the environment of the robot's ROS graph: %s", ", ".join(others))
    return {name: value for name, value in ros.items() if name in MIDDLEWARE.variables}


def _enter(ros: Mapping[str, str]) -> None:
    """Set a robot's ROS environment as this process's own; the middleware reads it when the node is created.

    In a pod of an older operator, the application can write what an earlier agent stored.
    """
    os.environ.update(MIDDLEWARE.introspecting({**os.environ, **_of_graph(ros)}))


def _reported(moment: float | None) -> float | None:
    """Return a time as one of the system's clock, for monitors on other machines."""
    return CLOCK.to_system(moment) if moment is not None else None
