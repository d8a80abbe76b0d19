"""Brings instances to where they belong while nothing is being recovered: the first one to driving, standbys to their pool's
readiness. A standby that was ready and isn't any more is replaced.

The procedures run in the agents (agent/procedure_runner.py), which remember what they brought their instance to, so that
nothing is done twice after a restart of this process.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import aiohttp

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.procedure_spec import Check
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import GAVE_WAY
from understudy.api.protocol.kept_state import KeptState
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.kube.client import ApiError
from understudy.monitor.act.pod_control import Fleet
from understudy.monitor.observe.agent_connections import Sidecars
from understudy.monitor.report.reporter import Reporter
from understudy.trees.languages.procedure_notations import composed
from understudy.trees.source.problems import TreeError

_logger = logging.getLogger(__name__)

LOST_FOR = 10.0
"""Seconds without readiness after which a standby that was ready is replaced."""

RETRY_FIRST, RETRY_MOST = 5.0, 60.0
"""Seconds before a procedure that failed is tried again."""

DRIVING = "up:"
"""How what an instance was brought to begins where that is driving."""


@dataclass(frozen=True)
class Expected:
    """What an instance should be brought to, and when it counts as ready."""

    procedure: BringUp | None = None
    brought: str = ""
    """What its success is remembered by; empty where nothing is done."""
    standby: Mapping[str, Any] | None = None
    """For its agent (agent/readiness.py); None where its health tree alone counts."""
    origin: str = ""
    """Where the procedure is written, for messages."""
    outdated: bool = False
    """Whether it was brought there by an earlier procedure."""


BRING_UP = "spec.bringUp of this RobotWorkload"


def expected(
    instance: Instance,
    spec: RobotWorkloadSpec,
    settings: WorkloadSettings,
    *,
    active_uid: str,
    brought: str = "",
    ready: bool = False,
) -> Expected:
    """What an instance should be; ``brought`` is what it was brought to, as far as is known, and ``ready`` whether it is
    what it was expected to be until now.

    A standby that is ready as an earlier procedure left it stays so: the present one may fail, and is run on the pod that
    the operator makes to take its place.
    """
    bring_up = BringUp.of("bringUp", spec.bring_up)
    if instance.uid == active_uid:
        pool = _pool(instance, settings)
        drives = brought.startswith(DRIVING) or (brought and pool is not None and pool.readiness == "Executing")
        if bring_up is None or drives:
            return Expected()
        return Expected(bring_up, _token(DRIVING, bring_up, instance), origin=BRING_UP)
    choice = _pool(instance, settings)
    if choice is None or (instance.from_source and not active_uid):
        if bring_up is None or instance.claim:
            return Expected()  # nothing is to be done, or a strategy of the policy does it
        token = _token(DRIVING, bring_up, instance)
        return Expected(bring_up, token, {"brought": token}, BRING_UP)
    initialization = BringUp.of("initialization", choice.initialization)
    procedure = initialization or (bring_up if choice.readiness == "Executing" else None)
    token = _token("init:" if initialization else DRIVING, procedure, instance) if procedure else ""
    if outdated := ready and brought != token and (not brought or _alike(brought, token)):
        token = brought
    check = choice.readiness_check
    if procedure is None and check is None:
        return Expected()
    standby: dict[str, Any] = {"brought": token, "tree": choice.readiness == "Executing"}
    if check is not None:
        standby |= {**_on_the_wire(check), "period": seconds(check.period)}
    origin = f"spec.initialization of FallbackPool {choice.name}" if initialization else BRING_UP
    return Expected(procedure, token, standby, origin, outdated)


def _on_the_wire(check: Check) -> dict[str, Any]:
    """A check in the short form, which is all that agents know."""
    try:
        found = composed(check, path="readinessCheck")
    except TreeError:
        return {"check": check.tree}  # the agent refuses it
    return {"check": found.node, **({"places": found.places} if found.places else {})}


def managed(spec: RobotWorkloadSpec, settings: WorkloadSettings, policy: FailurePolicySpec) -> bool:
    """Whether procedures bring instances up, so that their outputs may come long after their processes."""
    return (
        spec.bring_up is not None
        or any(pool.initialization for pool in settings.pools)
        or any(strategy.recovery for strategy in policy.strategies)
    )


def _pool(instance: Instance, settings: WorkloadSettings) -> PoolChoice | None:
    """The pool as whose standby an instance waits; what the workload's own controller makes waits as one of the first."""
    waiting = [pool for pool in settings.pools if pool.readiness != "Uninitialized"]
    if instance.from_source:
        return waiting[0] if waiting else None
    return next((pool for pool in waiting if pool.name == instance.pool), None)


def _token(kind: str, procedure: BringUp, instance: Instance) -> str:
    """A container that was started again must be brought up again."""
    return f"{kind}{procedure.digest}:{instance.restarts}"


def _alike(brought: str, token: str) -> bool:
    """Whether the same was done by perhaps another tree, to the same processes."""
    one, other = brought.split(":"), token.split(":")
    return len(one) == len(other) == 3 and (one[0], one[2]) == (other[0], other[2])


@dataclass
class _Care:
    """One instance that is cared for."""

    task: asyncio.Task[None] | None = None
    procedure: BringUp | None = None
    brought: str = ""
    """What the task brings it to."""
    again: float = 0.0
    wait: float = RETRY_FIRST
    problem: str = ""
    was_ready: bool = False
    lost_at: float | None = None
    replaced: bool = False


@dataclass
class Bringing:
    """Cares for all instances of one workload."""

    fleet: Fleet
    sidecars: Sidecars
    reporter: Reporter
    _cared: dict[str, _Care] = field(default_factory=dict)
    _told: bool = False
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
        """Look at every instance; called about once a second while nothing is being recovered, and returns at once."""
        now = time.monotonic()
        known = {instance.uid for instance in instances}
        for uid in [uid for uid in self._cared if uid not in known]:
            self._stop(self._cared.pop(uid))
        waiting: list[str] = []
        outdated: list[str] = []
        for instance in instances:
            if not instance.has_agent or instance.held or not instance.usable:
                continue
            care = self._cared.setdefault(instance.uid, _Care())
            status = self.sidecars.status(instance)
            if status is not None and status.configured:
                ready = care.was_ready or self.sidecars.is_ready(instance)[0]
                found = expected(
                    instance, spec, settings, active_uid=active_uid, brought=status.initialized, ready=ready
                )
                outdated += [instance.name] if found.outdated else []
                self._bring(instance, found, care, status.initialized, kept, now)
                if found.procedure is not None and status.initialized != found.brought:
                    waiting.append(f"{instance.name}: {care.problem or f'{found.procedure.name} is under way'}")
            if instance.uid == active_uid:
                care.was_ready, care.lost_at = False, None
            elif _pool(instance, settings) is not None and active_uid:
                self._watch_readiness(instance, care, now)
        self._say(instances, policy, spec, settings, waiting, outdated)

    def was_ready(self, instance: Instance) -> bool:
        """Whether it is a standby that was ready, and isn't replaced yet if it is so no more."""
        care = self._cared.get(instance.uid)
        return care is not None and care.was_ready

    def _bring(
        self, instance: Instance, found: Expected, care: _Care, brought: str, kept: Callable[[], KeptState], now: float
    ) -> None:
        procedure = found.procedure
        if procedure is None or brought == found.brought:
            care.problem, care.wait = "", RETRY_FIRST
            if procedure is None:
                self._stop(care)
            return
        if (care.procedure, care.brought) != (procedure, found.brought):
            # What became of the last one says nothing of this one, which may be its correction.
            self._stop(care)
            care.procedure, care.brought = procedure, found.brought
            care.problem, care.wait = "", RETRY_FIRST
        elif now < care.again or (care.task is not None and not care.task.done()):
            return
        care.task = asyncio.create_task(self._run(instance, procedure, found, care, kept))

    async def _run(
        self, instance: Instance, procedure: BringUp, found: Expected, care: _Care, kept: Callable[[], KeptState]
    ) -> None:
        state = kept() if procedure.restores_state else KeptState()
        try:
            await self.sidecars.run(instance, procedure, within=procedure.within, state=state, brought=found.brought)
        except NotVerified as error:
            care.again = time.monotonic() + care.wait
            care.wait = min(2 * care.wait, RETRY_MOST)
            problem = f"{error}. Correct {found.origin}, or what it waits for there; it is tried again"
            if GAVE_WAY not in str(error) and problem != care.problem:
                care.problem = problem
                self.reporter.event("Warning", "NotBroughtUp", f"{instance.name}: {problem}.")
        else:
            care.problem = ""
            _logger.info("%s: %s done", instance.name, procedure.name)

    def _watch_readiness(self, instance: Instance, care: _Care, now: float) -> None:
        """Replace a standby that was ready and hasn't been for a while. While the one in control isn't healthy itself, the
        reason may be the robot.
        """
        ready, reason = self.sidecars.is_ready(instance)
        if ready:
            care.was_ready, care.lost_at = True, None
            return
        # A standby that can't be reached from here alone may be as it should be: the API server then decides.
        unreachable = self.sidecars.status(instance) is None and instance.ready
        if not care.was_ready or care.replaced or unreachable or self.reporter.health != "Healthy":
            care.lost_at = None
            return
        if care.lost_at is None:
            care.lost_at = now
        elif now - care.lost_at >= LOST_FOR:
            care.replaced = True
            self._stop(care)
            _logger.warning("standby %s is replaced: %s", instance.name, reason)
            self.reporter.event(
                "Warning",
                "StandbyReplaced",
                f"{instance.name} was ready and hasn't been for {LOST_FOR:g} s ({reason}): it is deleted, and another one is made",
            )
            task = asyncio.create_task(self._replace(instance, care))
            self._replacing.add(task)
            task.add_done_callback(self._replacing.discard)

    async def _replace(self, instance: Instance, care: _Care) -> None:
        try:
            await self.fleet.retire(instance)
        except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            _logger.warning("standby %s not deleted: %s", instance.name, error)
            care.replaced, care.lost_at = False, None

    def _say(
        self,
        instances: Sequence[Instance],
        policy: FailurePolicySpec,
        spec: RobotWorkloadSpec,
        settings: WorkloadSettings,
        waiting: Sequence[str],
        outdated: Sequence[str],
    ) -> None:
        if not managed(spec, settings, policy):
            if self._told:
                self._told = False
                self.reporter.condition("BroughtUp", "True", "NothingToDo", "Nothing is done to instances (any more).")
            return
        self._told = True
        without = [i.name for i in instances if i.usable and not i.held and not i.has_agent]
        problems = [text for care in self._cared.values() if (text := care.problem)]
        if without:
            text = (
                f"{', '.join(without)} has no agent, since a referred controller made it: bringUp and recovery can't be run "
                "on it. Use a template, or have the application bring itself up."
            )
            if self.reporter.condition("BroughtUp", "False", "NoAgent", text):
                self.reporter.event("Warning", "NoAgent", text)
        elif problems:
            self.reporter.condition("BroughtUp", "False", "ProcedureFailed", f"{'. '.join(waiting or problems)}.")
        elif waiting:
            self.reporter.condition("BroughtUp", "Unknown", "UnderWay", "; ".join(waiting))
        else:
            text = "Every instance was brought to where it belongs."
            if outdated:
                text += f" {', '.join(outdated)} as an earlier procedure left it: delete the pod to have the present one run."
            self.reporter.condition("BroughtUp", "True", "BroughtUp", text)

    @staticmethod
    def _stop(care: _Care) -> None:
        if care.task is not None:
            care.task.cancel()
            care.task = None
