"""Prepares instances while no recovery is under way: runs the procedures of the active instance, and brings standbys to
their pool's readiness. Replaces a standby that was ready and no longer is.

The procedures run in the agents (agent/restoration/procedure_runner.py). The agents remember which procedure their instance has
completed, so that no procedure runs twice if this process restarts.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import GAVE_WAY
from understudy.api.protocol.kept_state import KeptState
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.kube.client import FAILURES
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.notices import Notices
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.instance_roles import InstanceRoles, Role, managed, pool_of, role_of

_logger = logging.getLogger(__name__)

LOST_FOR = 10.0
"""Seconds without readiness after which a standby that was ready is replaced."""

RETRY_FIRST, RETRY_MOST = 5.0, 60.0
"""Seconds before a failed procedure is tried again: first and maximum."""


@dataclass
class _InstanceState:
    """What this module remembers of one instance."""

    task: asyncio.Task[None] | None = None
    procedure: BringUp | None = None
    brought: str = ""
    """The identifier of the procedure and readiness that the task works towards (``Role.brought``)."""
    again: float = 0.0
    wait: float = RETRY_FIRST
    problem: str = ""
    lost_at: float | None = None
    replaced: bool = False


@dataclass
class StandbyLifecycle:
    """Prepares and supervises all instances of one workload."""

    fleet: PodControl
    agents: AgentConnections
    roles: InstanceRoles
    notices: Notices
    _cared: dict[str, _InstanceState] = field(default_factory=dict)
    _was_managed: bool = False
    _replacing: set[asyncio.Task[None]] = field(default_factory=set)

    def housekeeping(
        self,
        instances: Sequence[Instance],
        policy: FailurePolicySpec,
        spec: RobotWorkloadSpec,
        settings: WorkloadSettings,
        active_uid: str,
        kept: Callable[[], KeptState],
    ) -> None:
        """Start the procedures that are due, replace lost standbys, and report. Called about once a second while nothing is being
        recovered; returns at once."""
        now = time.monotonic()
        known = {instance.uid for instance in instances}
        for uid in [uid for uid in self._cared if uid not in known]:
            self._stop(self._cared.pop(uid))
        self.roles.keep_only(known)
        waiting: list[str] = []
        outdated: list[str] = []
        for instance in instances:
            if not instance.has_agent or instance.held or not instance.usable:
                continue
            care = self._cared.setdefault(instance.uid, _InstanceState())
            status = self.agents.status(instance)
            if status is not None and status.configured:
                ready = self.roles.was_ready_with(instance, status.initialized) or self.agents.is_ready(instance)[0]
                found = role_of(
                    instance, spec, settings, active_uid=active_uid, brought=status.initialized, ready=ready
                )
                outdated += [instance.name] if found.outdated else []
                self._bring(instance, found, care, status.initialized, kept, now)
                if found.procedure is not None and status.initialized != found.brought:
                    waiting.append(f"{instance.name}: {care.problem or f'{found.procedure.name} is under way'}")
            if instance.uid == active_uid:
                self.roles.forget(instance)
                care.lost_at = None
            elif pool_of(instance, settings) is not None and active_uid:
                self._watch_readiness(instance, care, now)
        self._report(instances, policy, spec, settings, waiting, outdated)

    def _bring(
        self,
        instance: Instance,
        found: Role,
        care: _InstanceState,
        brought: str,
        kept: Callable[[], KeptState],
        now: float,
    ) -> None:
        procedure = found.procedure
        if procedure is None or brought == found.brought:
            care.problem, care.wait = "", RETRY_FIRST
            if procedure is None:
                self._stop(care)
            return
        if (care.procedure, care.brought) != (procedure, found.brought):
            # This procedure may be the correction of the last one, so it starts at once, even if the last one failed.
            self._stop(care)
            care.procedure, care.brought = procedure, found.brought
            care.problem, care.wait = "", RETRY_FIRST
        elif now < care.again or (care.task is not None and not care.task.done()):
            return
        care.task = asyncio.create_task(self._run(instance, procedure, found, care, kept))

    async def _run(
        self, instance: Instance, procedure: BringUp, found: Role, care: _InstanceState, kept: Callable[[], KeptState]
    ) -> None:
        state = kept() if procedure.restores_state else KeptState()
        try:
            await self.agents.run(instance, procedure, within=procedure.within, state=state, brought=found.brought)
        except NotVerified as error:
            care.again = time.monotonic() + care.wait
            care.wait = min(2 * care.wait, RETRY_MOST)
            problem = f"{error}. Correct {found.origin}, or start what it waits for. The monitor tries it again"
            if GAVE_WAY not in str(error) and problem != care.problem:
                care.problem = problem
                self.notices.event("Warning", "NotBroughtUp", f"{instance.name}: {problem}.")
        else:
            care.problem = ""
            _logger.info("%s: %s done", instance.name, procedure.name)

    def _watch_readiness(self, instance: Instance, care: _InstanceState, now: float) -> None:
        """Replace a standby that was ready and has not been for LOST_FOR seconds. It stays if the active instance is
        not healthy either, because then the cause may be the robot."""
        ready, reason = self.agents.is_ready(instance)
        status = self.agents.status(instance)
        if ready and status is not None:
            self.roles.mark_ready(instance, status.initialized)
            care.lost_at = None
            return
        # If only this monitor cannot reach the standby's agent, the pod's readiness at the API server counts.
        unreachable = status is None and instance.ready
        if (
            not self.roles.was_ready(instance)
            or care.replaced
            or unreachable
            or self.notices.status.health != "Healthy"
        ):
            care.lost_at = None
            return
        if care.lost_at is None:
            care.lost_at = now
        elif now - care.lost_at >= LOST_FOR:
            care.replaced = True
            self._stop(care)
            _logger.warning("standby %s is replaced: %s", instance.name, reason)
            self.notices.event(
                "Warning",
                "StandbyReplaced",
                f"{instance.name} has not been ready for {LOST_FOR:g} s ({reason}): it is deleted, and a new one is created",
            )
            task = asyncio.create_task(self._replace(instance, care))
            self._replacing.add(task)
            task.add_done_callback(self._replacing.discard)

    async def _replace(self, instance: Instance, care: _InstanceState) -> None:
        try:
            await self.fleet.retire(instance)
        except FAILURES as error:
            _logger.warning("standby %s not deleted: %s", instance.name, error)
            care.replaced, care.lost_at = False, None

    def _report(
        self,
        instances: Sequence[Instance],
        policy: FailurePolicySpec,
        spec: RobotWorkloadSpec,
        settings: WorkloadSettings,
        waiting: Sequence[str],
        outdated: Sequence[str],
    ) -> None:
        if not managed(spec, settings, policy):
            if self._was_managed:
                self._was_managed = False
                self.notices.condition("BroughtUp", "True", "NothingToDo", "There is no procedure to run on instances.")
            return
        self._was_managed = True
        without = [i.name for i in instances if i.usable and not i.held and not i.has_agent]
        problems = [text for care in self._cared.values() if (text := care.problem)]
        if without:
            text = (
                f"The controller in spec.workloadRef created {', '.join(without)}, so the pod has no agent, and the procedures bringUp "
                "and recovery cannot run on it. Use spec.template, or let the application initialize itself."
            )
            if self.notices.condition("BroughtUp", "False", "NoAgent", text):
                self.notices.event("Warning", "NoAgent", text)
        elif problems:
            self.notices.condition("BroughtUp", "False", "ProcedureFailed", f"{'. '.join(waiting or problems)}.")
        elif waiting:
            self.notices.condition("BroughtUp", "Unknown", "UnderWay", "; ".join(waiting))
        else:
            text = "Every instance has reached its intended readiness."
            if outdated:
                text += (
                    f" {', '.join(outdated)} ran an earlier version of the procedure: delete the pod, so "
                    "that a new one runs the current version."
                )
            self.notices.condition("BroughtUp", "True", "BroughtUp", text)

    @staticmethod
    def _stop(care: _InstanceState) -> None:
        if care.task is not None:
            care.task.cancel()
            care.task = None
