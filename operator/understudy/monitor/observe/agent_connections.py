"""Keeps a connection to the agent of each instance, and gives each agent the present policy's health tree."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging
import math
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.protocol.agent_messages import PROTOCOL, RENEW_PERMIT, AgentStatus, GateEpoch, ProtocolError
from understudy.api.protocol.kept_state import LARGEST, KeptState, RestoreReport
from understudy.api.protocol.secure_channel import MonitorSecret
from understudy.clock import CLOCK
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.kube.agent_client import AgentGone, AgentLink, AgentRefused
from understudy.kube.client import FAILURES, SECRETS, Client
from understudy.kube.gates.base import Proof
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.observe.instance_roles import InstanceRoles
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

_logger = logging.getLogger(__name__)

PROBE_INTERVAL = 0.001
"""Seconds between probes around a commit."""

RETRY = 0.05
"""Seconds before an unanswered request is sent again; requests can be repeated."""

ANSWER_LATE = 1.0
"""Seconds after an operation's own deadline until its answer counts as lost: the network needs time too."""

READ_AGAIN = 10.0
"""Minimum seconds between two reads of a Secret whose token an agent refuses: the Secret may have changed since."""

CONFIRMED_FOR = 3.0
"""Seconds for which an answer of the API server about the gate counts before an agent is commanded.

A monitor that the API server does not answer may have a successor that has switched the gate. It commands nobody.
"""

CONFIRM_WITHIN = 2.0
"""Seconds for one such answer."""

RETRY_API = 0.25
"""Seconds before an API server that did not answer, or refused, is asked again."""

SLOWEST = 2 * 1024 * 1024
"""Minimum rate at which an agent receives kept messages, in bytes per second. The agent's own deadline starts only when it has
received them."""


class AgentConnections:
    """Implements :class:`understudy.failover.interfaces.Agents` over :class:`AgentLink`."""

    def __init__(
        self,
        client: Client,
        view: ClusterView,
        address: str,
        crash_points: CrashPoints,
        roles: InstanceRoles,
        wakeups: Wakeups,
        probes: Proof,
    ) -> None:
        """``address`` is the IP of this pod, to which agents send gate probes, and ``probes`` receives these."""
        self._client, self._view, self._address, self._probes = client, view, address, probes
        self._crash_points, self._roles, self._wakeups = crash_points, roles, wakeups
        self._links: dict[str, AgentLink] = {}
        self._connecting: dict[str, asyncio.Task[AgentLink | None]] = {}
        self._secrets: dict[str, MonitorSecret] = {}
        self._read_at: dict[str, float] = {}
        self._unread_at: dict[str, float] = {}
        """When a Secret could not be read, by its name."""
        self._configured: dict[str, object] = {}
        self._unconfigured: dict[str, str] = {}
        """Why an agent could not be configured last, by its pod's UID."""
        self._instances: dict[str, Instance] = {}
        self._driving: dict[str, str] = {}
        self._confirmed_at = -math.inf
        self._tasks: set[asyncio.Task[Any]] = set()

    def follow(self, instances: Sequence[Instance]) -> None:
        """Connect to each of these instances that has an agent, and close all other connections."""
        wanted = {i.uid: i for i in instances if i.has_agent and i.ip and not i.held and not i.leaving}
        self._instances = wanted
        for instance in instances:
            if instance.has_agent and instance.agent_protocol < PROTOCOL:
                self._probes.trust_unsigned(instance.uid)
        self._driving = {uid: to for uid, to in self._driving.items() if uid in wanted}
        # A pod that its node starts again, as after a loss of power, keeps its UID and has another address.
        old = [uid for uid, link in self._links.items() if uid not in wanted or wanted[uid].ip != link.host]
        for uid in old:
            self._configured.pop(uid, None)
            self._unconfigured.pop(uid, None)
            self._spawn(self._links.pop(uid).close())
        for uid, instance in wanted.items():
            if uid not in self._links:
                self._connect(instance)
            else:
                self._configure(uid)

    async def settle(self, instances: Sequence[Instance], within: float) -> None:
        """Follow the instances and wait until each agent has reported its state, for ``within`` seconds at most."""
        self.follow(instances)
        wanted = [i for i in instances if i.has_agent and i.running and not i.held and not i.terminating]
        end = asyncio.get_running_loop().time() + within
        while asyncio.get_running_loop().time() < end:
            statuses = [self.status(instance) for instance in wanted]
            if all(status is not None and status.configured for status in statuses):
                return
            await asyncio.sleep(RETRY)

    def _spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _connect(self, instance: Instance) -> asyncio.Task[AgentLink | None]:
        if instance.uid not in self._connecting:
            task = self._spawn(self._link(instance))
            self._connecting[instance.uid] = task
            task.add_done_callback(lambda _: self._connecting.pop(instance.uid, None))
        return self._connecting[instance.uid]

    async def _link(self, instance: Instance) -> AgentLink | None:
        secret = await self.secret(instance)
        if secret is None:
            return None
        self._instances.setdefault(instance.uid, instance)
        if instance.uid not in self._links:
            self._links[instance.uid] = AgentLink(
                instance.ip,
                instance.agent_port,
                secret,
                self._view.workload,
                instance.claim,
                uid=instance.uid,
                pod=instance.name,
                protocol=instance.agent_protocol,
                epoch=self._epoch,
                on_change=lambda link: self._changed(instance.uid, link),
            )
        return self._links[instance.uid]

    def _epoch(self) -> GateEpoch:
        """Return the epoch of the gate as this monitor knows it."""
        record, settings = self._view.gate_record, self._view.settings
        return GateEpoch(settings.uid, record.epoch) if record is not None and settings is not None else GateEpoch()

    async def _confirm(self, epoch: GateEpoch) -> None:
        """Ask the API server whether the gate is still at the epoch of a decision, unless it has just answered that.

        Raises AgentGone if it does not answer, NotVerified if somebody has switched the gate since.
        """
        if time.monotonic() - self._confirmed_at >= CONFIRMED_FOR:
            asked, name = time.monotonic(), names.gate(self._view.workload)
            try:
                async with asyncio.timeout(CONFIRM_WITHIN):
                    gate = await self._client.get(self._view.gate_kind.resource, self._view.namespace, name)
            except FAILURES as error:
                raise AgentGone(
                    f"not commanded, because the API server does not confirm the gate: {error!r}"
                ) from error
            self._view.gates.put(gate)
            self._confirmed_at = asked
        if (present := self._epoch()) != epoch:
            raise NotVerified(
                f"the gate was switched meanwhile (epoch {present.number}); the decision was of epoch {epoch.number}"
            )

    async def _wait_confirmed(self, epoch: GateEpoch) -> float:
        """Wait until the API server confirms the epoch of a decision. Returns how many seconds it did not answer.

        Raises NotVerified if somebody has switched the gate since.
        """
        started_at = time.monotonic()
        while True:
            try:
                await self._confirm(epoch)
                return time.monotonic() - started_at
            except AgentGone as error:
                _logger.warning("agents are %s", error)
                await asyncio.sleep(RETRY_API)

    async def secret(self, instance: Instance) -> MonitorSecret | None:
        """Return what an instance's agent accepts; None while the Secret cannot be read."""
        return await self._read_secret(self._secret_name(instance))

    def _secret_name(self, instance: Instance) -> str:
        return names.pool_secret(instance.pool) if instance.claim else names.agent_secret(self._view.workload)

    async def _read_secret(self, secret: str, *, again: bool = False) -> MonitorSecret | None:
        if again or secret not in self._secrets:
            if not again and time.monotonic() - self._unread_at.get(secret, -math.inf) < RETRY_API:
                return None
            self._read_at[secret] = time.monotonic()
            try:
                item = await self._client.get(SECRETS, self._view.namespace, secret)
                token, key = item["data"][names.TOKEN], item["data"].get(names.MONITOR_PRIVATE_KEY, "")
                self._secrets[secret] = MonitorSecret(base64.b64decode(token), base64.b64decode(key))
            except (*FAILURES, KeyError, ValueError) as error:
                _logger.warning(
                    "cannot read Secret %s, without which the monitor cannot connect to agents: %r", secret, error
                )
                self._unread_at[secret] = time.monotonic()
                return None
        return self._secrets[secret]

    def _changed(self, uid: str, link: AgentLink) -> None:
        if self._links.get(uid) is not link:
            return  # it is being closed, and connected just before
        if link.connected:
            if link.probe_key:
                self._probes.trust(uid, link.probe_key)
            self._configure(uid)
        else:
            self._configured.pop(uid, None)
            if link.refused and (instance := self._instances.get(uid)) is not None:
                self._spawn(self._renew(instance, link))
        self._wakeups.agent_reported()

    async def _renew(self, instance: Instance, link: AgentLink) -> None:
        """Read the Secret again after the agent refused the token or the claim: the Secret may have been recreated."""
        secret = self._secret_name(instance)
        again = time.monotonic() - self._read_at.get(secret, -READ_AGAIN) >= READ_AGAIN
        link.secret = await self._read_secret(secret, again=again) or link.secret

    def _configure(self, uid: str) -> None:
        """Send an agent its configuration in the background, if this connection has not sent the same one already."""
        link = self._links[uid]
        if not link.connected or (wanted := self._configuration(uid)) is None or self._configured.get(uid) == wanted:
            return
        self._configured[uid] = wanted
        epoch = self._epoch()

        async def configure() -> None:
            try:
                # A successor of this monitor may have configured the agent by a newer policy, at the same epoch.
                await self._confirm(epoch)
                if self._configured.get(uid) == wanted:
                    await self._send_settings(link, wanted)
                self._unconfigured.pop(uid, None)
            except (AgentGone, AgentRefused, NotVerified) as error:
                if self._unconfigured.get(uid) != str(error):  # it is tried again with each evaluation
                    _logger.warning("agent of %s not configured: %s", link.pod, error)
                self._unconfigured[uid] = str(error)
                if self._configured.get(uid) == wanted:
                    self._configured.pop(uid)

        self._spawn(configure())

    def _configuration(self, uid: str) -> tuple[Any, ...] | None:
        """Return the configuration with which an agent judges its instance; None while policy or spec is not known."""
        policy, spec, instance = self._view.policy, self._view.spec, self._instances.get(uid)
        if policy is None or spec is None:
            return None
        standby, managed = None, False
        if instance is not None:
            link = self._links.get(uid)
            status = link.status if link else None
            standby, managed = self._roles.readiness(
                instance, status.initialized if status else "", ready=self.is_ready(instance)[0]
            )
        if uid in self._driving:
            standby = None
        # With each epoch again, so that agents refuse what a monitor without contact to the API server decided before.
        return policy.monitoring, spec.outputs, standby, managed, self._epoch().number

    async def _send_settings(self, link: AgentLink, wanted: tuple[Any, ...]) -> None:
        monitoring, outputs, standby, managed, _ = wanted
        await link.configure(
            monitoring.tree,
            [output.to_wire() for output in outputs],
            seconds(monitoring.startup_grace),
            form=monitoring.form,
            probe=(self._address, names.PROBE_PORT),
            standby=standby,
            managed=managed,
        )

    async def _drives(self, instance: Instance, link: AgentLink) -> None:
        """Have the agent judge an instance that is about to drive by its health tree alone.

        Raises AgentGone and AgentRefused, and NotVerified if somebody has switched the gate since.
        """
        self._instances.setdefault(instance.uid, instance)
        self._driving[instance.uid] = instance.name
        wanted = self._configuration(instance.uid)
        if wanted is not None and self._configured.get(instance.uid) != wanted:
            await self._wait_confirmed(self._epoch())
            self._configured[instance.uid] = wanted
            try:
                await self._send_settings(link, wanted)
            except (AgentGone, AgentRefused, asyncio.CancelledError):
                self._configured.pop(instance.uid, None)
                raise

    async def _connected(self, instance: Instance) -> AgentLink:
        while True:
            # Other callers may wait for the same connection, so one that is cancelled must not end it.
            link = self._links.get(instance.uid) or await asyncio.shield(self._connect(instance))
            if link is not None:
                # It is closed when the pod gets another address, after its node restarted.
                with contextlib.suppress(AgentGone):
                    await link.wait_connected()
                    return link
            await asyncio.sleep(RETRY)

    def status(self, instance: Instance) -> AgentStatus | None:
        """Return what the instance's agent last reported; None while there is no connection."""
        link = self._links.get(instance.uid)
        return link.status if link else None

    @property
    def newest_epoch(self) -> int:
        """The newest epoch of the workload's gate that an agent knows; 0 if none has reported one."""
        uid = self._epoch().workload_uid
        found = [link.status.gate for link in self._links.values() if link.status is not None]
        return max((gate.number for gate in found if uid and gate.workload_uid == uid), default=0)

    async def probe(self, instance: Instance, duration: float) -> None:
        """Ask the instance's agent to send gate probes for ``duration`` seconds, at first 1 ms apart. Returns at once; never
        fails. Probes drive nobody, and the reflex needs them, so the API server is not asked."""
        body = {"host": self._address, "port": names.PROBE_PORT, "interval": PROBE_INTERVAL, "duration": duration}
        await self._request_soon(instance, "probe", body)

    async def give_way(self, instance: Instance) -> None:
        """Ask the instance's agent to keep a restarted container from reaching the robot. Returns at once; never fails."""
        await self._request_soon(instance, "give_way", {})

    async def _request_soon(self, instance: Instance, op: str, body: Mapping[str, Any]) -> None:
        link = self._links.get(instance.uid)
        if link is None or not link.connected:
            return

        async def request() -> None:
            try:
                await link.request(op, body)
            except (AgentGone, AgentRefused) as error:
                _logger.info("%s: %s", instance.name, error)

        self._spawn(request())

    def session(self, instance: Instance) -> tuple[int, int]:
        """Return a value that changes with every new connection to the instance's agent."""
        link = self._links.get(instance.uid)
        return (id(link), link.sessions) if link else (0, 0)

    async def renew_permit(self, instance: Instance, body: Mapping[str, Any]) -> None:
        """Send an agent the addresses that may answer its instance, and the order for the instance if it is frozen.

        A held instance continues only if the API server confirms the decision. Raises AgentGone, AgentRefused, NotVerified.
        """
        link = self._links.get(instance.uid)
        if link is None:
            raise AgentGone(f"{instance.name}: its agent is not connected")
        epoch = self._epoch()
        if body.get("word") == "Go":
            await self._confirm(epoch)
        await link.request(RENEW_PERMIT, body, within=ANSWER_LATE, epoch=epoch)

    async def start(self, instance: Instance) -> None:
        """Start the held processes of a claimed instance with this robot's settings. May be repeated. Raises NotVerified."""
        settings, epoch = self._view.settings, self._epoch()
        assert settings is not None, "the cluster view has started, so there are settings"
        self._crash_points.step("before start")
        while True:
            link = await self._connected(instance)
            await self._wait_confirmed(epoch)
            try:
                await link.start(
                    settings.container_environment, settings.ros_environment, profiles=settings.instance_profiles
                )
                break
            except AgentGone as error:
                _logger.warning("start of %s: %s", instance.name, error)
                await asyncio.sleep(RETRY)
            except AgentRefused as error:  # as if another monitor has switched the gate since
                raise NotVerified(str(error)) from error
        self._crash_points.step("after start")

    async def up(self, instance: Instance) -> float:
        """Wait until the instance's processes run. Returns since when they do."""
        while True:
            link = await self._connected(instance)
            with contextlib.suppress(AgentGone):
                status = await link.wait_for(lambda status: status.process_up_at is not None)
                assert status.process_up_at is not None
                return _past(status.process_up_at)

    async def ready(self, instance: Instance) -> float:
        """Wait until the health tree succeeds on the instance's own outputs. Returns since when it does. Raises NotVerified."""
        while True:
            link = await self._connected(instance)
            try:
                await self._drives(instance, link)
            except (AgentGone, AgentRefused) as error:
                _logger.warning("agent of %s not configured: %s", instance.name, error)
                await asyncio.sleep(RETRY)
                continue
            with contextlib.suppress(AgentGone):
                status = await link.wait_for(
                    lambda status: status.configured and status.ready and status.ready_at is not None
                )
                assert status.ready_at is not None
                return _past(status.ready_at)

    async def bring_up(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState
    ) -> RestoreReport:
        """Run a procedure on an instance that is about to drive, for ``within`` seconds at most. Raises NotVerified."""
        self._crash_points.step("before bring up")
        self._driving[instance.uid] = instance.name
        brought = f"up:{procedure.digest}:{instance.restarts}"
        report = await self.run(instance, procedure, within=within, state=state, brought=brought)
        self._crash_points.step("after bring up")
        return report

    async def run(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState, brought: str
    ) -> RestoreReport:
        """Run a procedure on an instance, for ``within`` seconds at most. The agent remembers its success as ``brought``.

        Raises NotVerified with the reason if the procedure does not succeed.
        """
        if procedure.problem:
            raise NotVerified(procedure.problem)
        epoch, end = self._epoch(), asyncio.get_running_loop().time() + within
        wire = await asyncio.to_thread(state.to_wire) if state or state.left_out else None

        async def answer(link: AgentLink, rest: float) -> RestoreReport:
            tree, name, places = procedure.tree, procedure.name, procedure.places
            found = await link.procedure(tree, rest, name=name, state=wire, brought=brought, places=places, epoch=epoch)
            return RestoreReport.from_wire(found)

        try:
            return await self._answered(instance, epoch, end, answer)
        except (AgentRefused, ProtocolError) as error:
            raise NotVerified(str(error)) from error
        except TimeoutError as error:
            raise NotVerified(
                f"{procedure.name} of {instance.name}: not done within {within:.3g} s: {error}"
            ) from error

    async def _answered(
        self,
        instance: Instance,
        epoch: GateEpoch,
        end: float,
        answer: Callable[[AgentLink, float], Awaitable[RestoreReport]],
    ) -> RestoreReport:
        """Return the answer of an instance's agent, asked again until there is one or until ``end`` by the loop's clock.

        ``epoch`` is that of the decision. ``answer`` receives the connection and the seconds that are left. Raises TimeoutError with the
        last problem, NotVerified if the decision is stale, and what ``answer`` raises if the agent refuses.
        """
        loop, problem = asyncio.get_running_loop(), "its agent is not connected"
        while (rest := end - loop.time()) > 0:
            try:
                async with asyncio.timeout(rest):
                    link = await self._connected(instance)
                end += await self._wait_confirmed(epoch)
                return await answer(link, max(0.1, end - loop.time()))
            except (AgentGone, TimeoutError) as error:
                problem = str(error) or problem
                await asyncio.sleep(RETRY)
        raise TimeoutError(problem)

    async def restore(self, instance: Instance, state: KeptState, within: float) -> RestoreReport:
        """Restore kept state on an instance, for ``within`` seconds at most. The report lists what could not be restored."""
        end = asyncio.get_running_loop().time() + within
        report = RestoreReport()
        for part in await asyncio.gather(*(self._give(instance, part, end) for part in state.batches(LARGEST))):
            report = report.merged(part)
        return report

    async def _give(self, instance: Instance, state: KeptState, end: float) -> RestoreReport:
        """Restore a part of the state that fits into one request, until ``end`` by the loop's clock."""
        epoch, late = self._epoch(), ANSWER_LATE + state.size / SLOWEST
        within = end - asyncio.get_running_loop().time()
        wire = await asyncio.to_thread(state.to_wire)

        async def answer(link: AgentLink, rest: float) -> RestoreReport:
            body = {"state": wire, "within": rest}
            found = await link.request("restore", body, within=rest + late, epoch=epoch)
            return RestoreReport.from_wire(found.get("report", {}))

        try:
            return await self._answered(instance, epoch, end, answer)
        except (AgentRefused, NotVerified, ProtocolError) as error:
            return state.none_restored(str(error))
        except TimeoutError as error:
            return state.none_restored(f"{error} within {within:.3g} s")

    async def inspect(self, instance: Instance, body: Mapping[str, Any], within: float) -> dict[str, Any]:
        """Return parameters and lifecycle states of an instance's nodes, as its agent reads them. Raises AgentGone, AgentRefused."""
        link = self._links.get(instance.uid)
        if link is None:
            raise AgentGone("its agent is not connected")
        return await link.request("inspect", {**body, "within": within}, within=within + ANSWER_LATE)

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        """Return whether the health tree succeeds on the instance's own outputs now, and if not, why."""
        link = self._links.get(instance.uid)
        if link is None:
            return False, "its agent is not connected yet"
        status = link.status
        if status is None:
            return False, f"its agent is not connected: {link.problem}"
        if not status.configured or status.phase == "Held":
            return False, f"its agent is {status.phase.lower()}"
        return status.ready, "" if status.ready else status.reason or "its outputs are not healthy"


def _past(reported: float) -> float:
    """Return a time that an agent reported as one of this process's clock. The clock of the agent's node may be ahead."""
    return min(CLOCK.of_system(reported), CLOCK.now())
