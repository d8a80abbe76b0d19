"""The monitor's connection to the action proxy: tells the proxy which instance is active, and reports its tasks.

The proxy is a separate process in the monitor's pod, and continues if the monitor restarts.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.kinds.task_spec import TaskStatus
from understudy.failover.interfaces import Gate, GateState, Instance
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.objects import own_pod
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.robot.health_observer import HealthObserver

_logger = logging.getLogger(__name__)

CHECK_PERIOD = 0.25
"""Maximum seconds between two checks of the situation; a change of the gate or of a pod is noticed at once."""

RETRY = 0.2
"""Seconds before the next attempt to connect to the proxy."""

PATIENCE = 30.0
"""Seconds after which an unreachable proxy is reported."""

MOST = 1 << 20
"""Maximum bytes of one line."""

CONDITION = "TasksProxied"


class ActionProxyLink:
    """Keeps the proxy informed until cancelled."""

    def __init__(
        self,
        socket: Path,
        view: ClusterView,
        fleet: PodControl,
        gate: Gate,
        agents: AgentConnections,
        notices: Notices,
        observer: HealthObserver,
    ) -> None:
        """``socket`` is the path of the proxy's socket."""
        self._socket = socket
        self._view, self._fleet, self._gate = view, fleet, gate
        self._agents, self._notices, self._observer = agents, notices, observer

    async def run(self) -> None:
        """Connect, send and listen; connect again if the connection ends."""
        away_since = time.monotonic()
        while True:
            spec = self._view.spec
            if spec is None or not spec.tasks or spec.workload_ref is not None:
                self._report_missing_agents(spec)
                away_since = time.monotonic()
                await asyncio.sleep(1.0)
                continue
            try:
                reader, writer = await asyncio.open_unix_connection(self._socket, limit=MOST)
            except OSError as error:
                if time.monotonic() - away_since > PATIENCE:
                    words = (
                        f"The monitor cannot reach the action proxy (container {names.TASKS_CONTAINER} of the monitor's pod, see its "
                        f"logs): {error}"
                    )
                    self._set_condition("False", "ProxyNotReady", words)
                await asyncio.sleep(RETRY)
                continue
            try:
                async with asyncio.TaskGroup() as group:
                    sending = group.create_task(self._send_states(writer))
                    await self._listen(reader)
                    sending.cancel()
            except* OSError as group_error:
                _logger.info("the connection to the action proxy ended: %s", group_error.exceptions[0])
            except* (ValueError, KeyError, TypeError) as group_error:
                _logger.error("the action proxy sent an invalid message: %r", group_error.exceptions[0])
            except* Exception:
                # An error of any kind must not end the monitor.
                _logger.exception("the connection to the action proxy failed")
            finally:
                writer.close()
            away_since = time.monotonic()
            await asyncio.sleep(RETRY)

    async def _send_states(self, writer: asyncio.StreamWriter) -> None:
        sent: dict[str, Any] | None = None
        while True:
            changes = [
                asyncio.ensure_future(source.changed()) for source in (self._view.gates, *self._view.pod_watches)
            ]
            try:
                spec = self._view.spec
                if spec is not None and (present := await self._situation(spec)) != sent:
                    sent = present
                    writer.write(json.dumps({"situation": present}).encode() + b"\n")
                    await writer.drain()
                await asyncio.wait(changes, timeout=CHECK_PERIOD, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for change in changes:
                    change.cancel()

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            report = json.loads(line)["report"]
            self._report(report)
            # An earlier proxy does not report it.
            if any(task.get("unasked") for task in report["tasks"]):
                await self._look_at_active()

    async def _look_at_active(self) -> None:
        """See whether the active pod is being deleted: its application aborts its goals then, which is no end of them."""
        active = self._fleet.find(self._gate.state.active_uid)
        if active is not None and not active.leaving:
            await self._fleet.look_at(active)

    async def _situation(self, spec: RobotWorkloadSpec) -> dict[str, Any]:
        """The present situation, in the wire format of the proxy's Situation."""
        state = self._gate.state
        settings = self._view.settings
        full = {choice.name for choice in settings.pools if choice.level.runs_in_full} if settings else set[str]()
        peers = []
        for instance in self._fleet.of_workload():
            if not reachable(instance, state):
                continue
            secret = await self._agents.secret(instance)
            if secret is not None:
                peers.append(
                    {
                        "uid": instance.uid,
                        "pod": instance.name,
                        "ip": instance.ip,
                        "port": instance.agent_port,
                        "token": secret.token.decode(),
                        "key": secret.key.hex(),
                        "claim": instance.claim,
                        "executing": executing(instance, state, full),
                        "protocol": instance.agent_protocol,
                    }
                )
        return {
            "workload": self._view.workload,
            "workload_uid": settings.uid if settings is not None else "",
            "pod_deleted": self._view.pod_deleted,
            "epoch": state.epoch,
            "active": state.active_uid,
            "on_board": self._observer.drove_on_board,
            "is_confirmed": self._gate.unanswered_since is None and own_pod.is_confirmed(self._view),
            "settled": settled(self._notices.status.health, self._fleet.find(state.active_uid)),
            "rules": [
                {
                    "action": task.action,
                    "type": task.type,
                    "on_failover": task.on_failover,
                    "abort_grace": seconds(task.abort_grace),
                }
                for task in spec.tasks
            ],
            "peers": peers,
        }

    def _report(self, report: Mapping[str, Any]) -> None:
        tasks = report["tasks"]
        try:
            self._notices.set_tasks(
                [
                    TaskStatus(
                        action=task["action"], active=task["active"], resent=task["resent"], message=task["message"]
                    )
                    for task in tasks
                ]
            )
        except ValidationError as error:
            raise ValueError(str(error)) from error
        self._set_condition(*judged(tasks, self._problem))

    @property
    def _problem(self) -> str:
        """The problem that the operator found in the configuration of the tasks."""
        return self._view.settings.tasks_problem if self._view.settings else ""

    def _report_missing_agents(self, spec: RobotWorkloadSpec | None) -> None:
        self._notices.set_tasks([])
        if spec is not None and spec.tasks and self._problem:
            self._set_condition("False", "NoAgent", self._problem)
        else:
            self._notices.withdraw(CONDITION)

    def _set_condition(self, status: str, reason: str, message: str) -> None:
        if self._notices.condition(CONDITION, status, reason, message) and status == "False":
            self._notices.event("Warning", reason, message)


def reachable(instance: Instance, state: GateState) -> bool:
    """Whether the proxy can send goals to an instance. An instance that is being deleted counts only while it is
    active."""
    leaving = instance.terminating and instance.uid != state.active_uid
    return instance.has_agent and bool(instance.ip) and instance.running and not instance.held and not leaving


def executing(instance: Instance, state: GateState, full: set[str]) -> bool:
    """Whether an instance is an executing standby: a pod of an executing pool, or, if such a pool exists, a pod of the
    workload's own controller."""
    standby = instance.uid != state.active_uid and not instance.claim
    return standby and (instance.pool in full or (instance.from_source and bool(full)))


def settled(health: str, active: Instance | None) -> bool:
    """Whether no failure is known, no recovery is under way, and the active pod runs."""
    return health not in ("Failed", "Recovering") and active is not None and active.running and not active.leaving


def judged(tasks: Sequence[Mapping[str, Any]], problem: str) -> tuple[str, str, str]:
    """Status, reason and message of the condition TasksProxied."""
    messages = [f"{task['action']}: {task['message']}" for task in tasks if task["message"]]
    if any("not installed" in message for message in messages):
        return "False", "TypeNotInstalled", f"spec.tasks: {'. '.join(messages)}"
    if problem:
        return "False", "OwnProfiles", problem
    if messages:
        return "False", "GoalsNotSent", ". ".join(messages)
    actions = ", ".join(task["action"] for task in tasks)
    if not tasks:
        return "Unknown", "Starting", "The action proxy does not serve yet."
    if not all(task["served"] for task in tasks):
        return "Unknown", "Starting", f"The action proxy does not serve all of these actions yet: {actions}."
    return "True", "Serving", f"The action proxy serves {actions}."
