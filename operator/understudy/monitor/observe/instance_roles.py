"""The readiness that each instance should reach: the active one drives, and standbys have their pool's readiness."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.procedure_spec import Check
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import BEGUN
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Gate, Instance
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.trees.languages.procedure_notations import composed
from understudy.trees.source.problems import TreeError

DRIVING = "up:"
"""Prefix of ``brought`` for an instance that was brought up to drive."""


@dataclass(frozen=True)
class Role:
    """The readiness that an instance should reach, and when it counts as ready."""

    procedure: BringUp | None = None
    brought: str = ""
    """The token with which the agent remembers the procedure's success; empty without a procedure."""
    standby: Mapping[str, Any] | None = None
    """The readiness check for the agent (agent/readiness.py); None if the health tree alone counts."""
    origin: str = ""
    """The field that defines the procedure, for messages."""
    outdated: bool = False
    """Whether the instance reached its readiness with an earlier version of the procedure."""


BRING_UP = "spec.bringUp of this RobotWorkload"


def role_of(
    instance: Instance,
    spec: RobotWorkloadSpec,
    settings: WorkloadSettings,
    *,
    active_uid: str,
    brought: str = "",
    ready: bool = False,
) -> Role:
    """Return the role of an instance. ``brought`` is the readiness that it reached, if known; ``ready`` is whether it
    has been ready with that.

    A standby that an earlier version of the procedure made ready keeps that role. The present version may fail, so it runs
    only on a new pod.
    """
    bring_up = BringUp.of("bringUp", spec.bring_up)
    if instance.uid == active_uid:
        pool = pool_of(instance, settings)
        runs_in_full = bool(brought) and pool is not None and pool.level.runs_in_full
        drives = brought.startswith(DRIVING) or (runs_in_full and not brought.startswith(BEGUN))
        if bring_up is None or drives:
            return Role()
        return Role(bring_up, _token(DRIVING, bring_up, instance), origin=BRING_UP)
    choice = pool_of(instance, settings)
    if choice is None or (instance.from_source and not active_uid):
        if bring_up is None or instance.claim:
            return Role()  # no procedure, or a strategy of the policy runs it
        token = _token(DRIVING, bring_up, instance)
        return Role(bring_up, token, {"brought": token}, BRING_UP)
    initialization = BringUp.of("initialization", choice.initialization)
    procedure = initialization or (bring_up if choice.level.runs_in_full else None)
    token = _token("init:" if initialization else DRIVING, procedure, instance) if procedure else ""
    if outdated := ready and brought != token and (not brought or _alike(brought, token)):
        token = brought
    check = choice.readiness_check
    if procedure is None and check is None:
        return Role()
    standby: dict[str, Any] = {"brought": token, "tree": choice.level.runs_in_full}
    if check is not None:
        standby |= {**_on_the_wire(check), "period": seconds(check.period)}
    origin = f"spec.initialization of FallbackPool {choice.name}" if initialization else BRING_UP
    return Role(procedure, token, standby, origin, outdated)


def _on_the_wire(check: Check) -> dict[str, Any]:
    """Return a check in the short form, the only one that agents read."""
    try:
        found = composed(check, path="readinessCheck")
    except TreeError:
        return {"check": check.tree}  # the agent refuses this tree and reports why
    return {"check": found.node, **({"places": found.places} if found.places else {})}


def managed(spec: RobotWorkloadSpec, settings: WorkloadSettings, policy: FailurePolicySpec) -> bool:
    """Return whether procedures bring instances up. If so, outputs may begin long after the processes start."""
    return (
        spec.bring_up is not None
        or any(pool.initialization for pool in settings.pools)
        or any(strategy.recovery for strategy in policy.strategies)
    )


def pool_of(instance: Instance, settings: WorkloadSettings) -> PoolChoice | None:
    """Return the pool of a standby; None if there is none. A pod of the workload's own controller belongs to the first pool."""
    waiting = [pool for pool in settings.pools if pool.level.has_standbys]
    if instance.from_source:
        return waiting[0] if waiting else None
    return next((pool for pool in waiting if pool.name == instance.pool), None)


def _token(kind: str, procedure: BringUp, instance: Instance) -> str:
    """Return the token for a procedure's success. It includes the restarts, because a restarted container needs the procedure again."""
    return f"{kind}{procedure.digest}:{instance.restarts}"


def _alike(brought: str, token: str) -> bool:
    """Return whether two tokens are for the same kind of procedure and the same processes; the trees may differ."""
    one, other = brought.split(":"), token.split(":")
    return len(one) == len(other) == 3 and (one[0], one[2]) == (other[0], other[2])


class InstanceRoles:
    """The roles of one workload's instances, and which standbys were ready before."""

    def __init__(self, view: ClusterView, gate: Gate, current: CurrentRecovery) -> None:
        self._view, self._gate, self.current = view, gate, current
        self._were_ready: dict[str, str] = {}
        """By UID of a standby that was ready: the token of the procedure that had made it so (``AgentStatus.initialized``)."""

    @property
    def driver(self) -> str:
        """UID of the active pod. While a recovery is deferred, this is the failed pod, so that no standby is prepared to replace it."""
        held = self.current.held
        return held.failed[0].uid if held is not None and held.failed else self._gate.state.active_uid

    def was_ready(self, instance: Instance) -> bool:
        """Return whether an instance is a standby that was ready before. If it is no longer ready, it will be replaced."""
        return instance.uid in self._were_ready

    def was_ready_with(self, instance: Instance, brought: str) -> bool:
        """Return whether a standby was ready with this token. A procedure that begins takes the token away, and the readiness with it."""
        return self._were_ready.get(instance.uid) == brought

    def mark_ready(self, instance: Instance, brought: str) -> None:
        """Remember that a standby was ready with this token."""
        self._were_ready[instance.uid] = brought

    def forget(self, instance: Instance) -> None:
        """An instance in control is no standby: forget that it was ready as one."""
        self._were_ready.pop(instance.uid, None)

    def keep_only(self, uids: Collection[str]) -> None:
        """Forget every other instance."""
        self._were_ready = {uid: brought for uid, brought in self._were_ready.items() if uid in uids}

    def readiness(self, instance: Instance, brought: str, *, ready: bool) -> tuple[Mapping[str, Any] | None, bool]:
        """Return what the agent of an instance must check (see :attr:`Role.standby`), and whether procedures bring instances up.

        ``brought`` is the readiness that the instance reached; ``ready`` is whether its agent reports it as ready now.
        """
        policy, spec, settings = self._view.policy, self._view.spec, self._view.settings
        if policy is None or spec is None or settings is None:
            return None, False
        ready = ready or self.was_ready_with(instance, brought)
        role = role_of(instance, spec, settings, active_uid=self.driver, brought=brought, ready=ready)
        return role.standby, managed(spec, settings, policy)
