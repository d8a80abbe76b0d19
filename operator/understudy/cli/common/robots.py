"""RobotWorkloads and FallbackPools for people: the active instance, whether the robot is protected, and the problems.

Everything comes from the status that operator and monitor write, except a recovery under way: the gate records that first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pydantic import Field, ValidationError

from understudy.api.base import Model
from understudy.api.conditions import Condition, is_summary
from understudy.api.health_reasons import PAST
from understudy.api.kinds.fallback_pool import FallbackPoolStatus, has_standbys
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.cli.common.errors import CommandError
from understudy.cli.common.recovery_under_way import UnderWay, under_way
from understudy.cli.common.text.wording import counted, listed
from understudy.controller.status.protection import LIMIT_CONDITIONS
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateRecord
from understudy.kube.gates.mux_reports import SWITCHED_BY_MUX

Object = Mapping[str, Any]

DRIVEN = ("Healthy", "Degraded")
"""Healths of a robot whose active instance works."""

UNWATCHED = "Unwatched"
"""Shown instead of the last reported health if no monitor is running."""

_UNWATCHED = ("MonitorNotReady", "GateMissing")
"""Reasons of the condition Protected that mean that no monitor watches the robot."""

_ABOUT = {
    "Accepted": "not accepted",
    "Reconciled": "not reconciled",
    "Protected": "not protected",
    "MemorySufficient": "memory of the monitor too low",
    "PolicyMapSufficient": "too little room in Cilium's policy map",
    "Monitored": "not fully monitored",
    "Healthy": "not healthy",
    "Degraded": "degraded",
    "Recovering": "not recovered",
    "DependencyFailed": "suspended by a dependency",
    "DependenciesResolved": "dependencies not resolved",
    "GateEnforced": "gate not enforced",
    "SoleDriver": "several drivers",
    "OutputsRead": "outputs bypass the gate",
    "BroughtUp": "bring-up failed",
    "Resized": "not resized",
    "Draining": "evictions do not wait",
    "StrategiesChosen": "requirements not met",
    "SituationCovered": "situation not covered",
    "Available": "no pod available",
    "Sized": "too small for spec.sizing.risk",
    "Updated": "not updated",
    "Reflex": "reflex not active",
    "StateKept": "state not kept",
    "StateRestored": "state not restored",
    "TasksProxied": "goals not proxied",
    "Paused": "paused",
    "WithinBudget": "budget spent",
    "Ready": "not ready",
}
"""What a condition reports if it is not in its good state."""


class Problem(Model):
    """One problem of an object."""

    type: str = Field(description="Type of the condition that reports it.")
    reason: str = Field(description="Reason of the condition.")
    message: str = Field(description="What was found, and how to solve it.")
    since: str | None = Field(default=None, description="When the condition changed last.")

    @property
    def about(self) -> str:
        """The kind of problem, in words."""
        if self.type == "Recovering" and self.reason in ("FailureDetected", "Rescheduling", "FollowsDependency"):
            return "recovering"
        return _ABOUT.get(self.type, self.type)


class LastRecovery(Model):
    """Summary of the newest recovery."""

    number: int
    result: str
    strategy: str
    reason: str
    planned: bool
    recovery_seconds: float | None
    ended: str | None = None

    @classmethod
    def of(cls, recovery: Recovery) -> LastRecovery:
        """Summarize the record."""
        moments = recovery.moments
        ended = moments.verified or moments.routed or moments.detected
        return cls(**recovery.model_dump(include=set(cls.model_fields)), ended=ended)


class Robot(Model):
    """One RobotWorkload."""

    namespace: str
    name: str
    policy: str
    gate: str
    """The kind of its gate."""
    created: str | None
    health: str
    """As the monitor reports it, or UNWATCHED; also Recovering if only the gate records a recovery."""
    protected: bool
    active: str
    epoch: int
    standby: str
    strategy: str
    """The strategy that the monitor would use for a failure now."""
    situation: str
    """The situation of its policy that applies; empty for none."""
    recovery_count: int
    last_recovery: LastRecovery | None
    recovering: UnderWay | None = None
    """The recovery under way that the gate records, if any."""
    problems: list[Problem]

    @property
    def is_well(self) -> bool:
        """Whether it is protected and its active instance works."""
        return self.protected and self.health in DRIVEN


class Pool(Model):
    """One FallbackPool."""

    namespace: str
    name: str
    readiness: str
    desired: int
    ready: int
    claimed: int
    problems: list[Problem]

    @property
    def is_short(self) -> bool:
        """Whether fewer pods than desired are ready. A standby that became the active instance counts as ready."""
        return self.ready + (self.claimed if has_standbys(self.readiness) else 0) < self.desired


def summary(robots: Sequence[Robot]) -> str:
    """Summarize all robots in one line."""
    unprotected = sum(not robot.protected for robot in robots)
    healths = Counter(robot.health for robot in robots)
    counts = listed(f"{healths[health]} {health.lower()}" for health in sorted(healths))
    protected = f"{unprotected} not protected" if unprotected else "all protected"
    return f"{counted(len(robots), 'robot')}: {protected}; {counts}"


def status_of(item: Object) -> RobotWorkloadStatus:
    """Parse the status of a RobotWorkload. Raises CommandError if it does not match this version."""
    try:
        return RobotWorkloadStatus.model_validate(item.get("status") or {})
    except ValidationError as error:
        raise CommandError(_unknown_status("RobotWorkload", item, error)) from error


def robot(item: Object, gate: dict[str, Any] | None = None, now: float = 0.0) -> Robot:
    """Summarize a RobotWorkload, with its ``gate`` if it could be read, at ``now`` (unix seconds). Raises CommandError."""
    status, metadata, spec = status_of(item), item["metadata"], item.get("spec") or {}
    conditions = {condition.type: condition for condition in status.conditions or []}
    protected = conditions.get("Protected")
    unwatched = protected is not None and protected.status == "False" and protected.reason in _UNWATCHED
    recovering = under_way(status, gate, now) if not unwatched else None
    active, epoch = status.active or "", status.gate.epoch if status.gate is not None else 0
    if recovering is not None and gate is not None:
        record = GateRecord.of(gate)
        active, epoch = record.active, record.epoch
    health = "Recovering" if recovering is not None else status.health or "Unknown"
    return Robot(
        namespace=metadata["namespace"],
        name=metadata["name"],
        policy=(spec.get("failurePolicyRef") or {}).get("name", ""),
        gate=registry.of(dict(item)).kind,
        created=metadata.get("creationTimestamp"),
        health=UNWATCHED if unwatched else health,
        protected=protected is not None and protected.status == "True",
        active=active,
        epoch=epoch,
        standby=status.standby or "Unknown",
        strategy=status.strategy or "",
        situation=status.situation.name if status.situation is not None else "",
        recovery_count=status.recovery_count or 0,
        last_recovery=LastRecovery.of(status.recoveries[0]) if status.recoveries else None,
        recovering=recovering,
        problems=problems(item, status.conditions or [], status.observed_generation, recovering),
    )


def pool(item: Object) -> Pool:
    """Summarize a FallbackPool. Raises CommandError."""
    try:
        status = FallbackPoolStatus.model_validate(item.get("status") or {})
    except ValidationError as error:
        raise CommandError(_unknown_status("FallbackPool", item, error)) from error
    return Pool(
        namespace=item["metadata"]["namespace"],
        name=item["metadata"]["name"],
        readiness=(item.get("spec") or {}).get("readiness", ""),
        desired=status.desired or 0,
        ready=status.ready or 0,
        claimed=status.claimed or 0,
        problems=problems(item, status.conditions or [], status.observed_generation),
    )


def problems(
    item: Object, conditions: Iterable[Condition], observed_generation: int | None, recovering: UnderWay | None = None
) -> list[Problem]:
    """List the problems that an object's conditions report, and the recovery under way.

    ``observed_generation`` is the generation of the spec that the conditions refer to.
    """
    found, conditions = list(_unobserved(item, observed_generation)), list(conditions)
    if recovering is not None and not _status_has_details(conditions, recovering):
        conditions = [condition for condition in conditions if condition.type != "Recovering"]
        reason, message = recovering.occasion, recovering.message
        found.append(Problem(type="Recovering", reason=reason, message=message, since=recovering.since))
    wired = [condition.to_wire() for condition in conditions]
    protected = next((c for c in conditions if c.type == "Protected" and c.status == "False"), None)
    gate = next((c.reason for c in conditions if c.type == "GateEnforced" and c.status == "False"), "")
    for condition in conditions:
        if not _is_problem(condition) or is_summary(condition.to_wire(), wired):
            continue
        same = protected is not None and protected.reason == condition.reason
        if condition.type == "Reconciled" and (same or condition.reason == "NotAccepted"):
            continue  # reported already
        if condition.type == "OutputsRead" and condition.reason == gate:
            continue
        if protected is not None and protected.reason == LIMIT_CONDITIONS.get(condition.type):
            continue
        found.append(
            Problem(
                type=condition.type,
                reason=condition.reason,
                message=condition.message,
                since=condition.last_transition_time,
            )
        )
    first = {"Protected": 0, "Accepted": 1, "Healthy": 2, "Recovering": 3}
    return sorted(found, key=lambda problem: first.get(problem.type, len(first)))


def is_reported(problem: Problem, messages: Iterable[str]) -> bool:
    """Return whether a pool's problem concerns a pod that one of these messages reports already."""
    cause = problem.message.partition("; ")[2].rstrip(".")
    return bool(cause) and any(cause in message for message in messages)


def _status_has_details(conditions: Iterable[Condition], recovering: UnderWay) -> bool:
    """Return whether the status says more about a recovery than that it is under way, such as what it waits for."""
    reported = next((condition for condition in conditions if condition.type == "Recovering"), None)
    return reported is not None and reported.status == "True" and reported.reason != recovering.occasion


def _unobserved(item: Object, observed_generation: int | None) -> Iterator[Problem]:
    generation = item["metadata"].get("generation")
    if observed_generation is None or (generation is not None and observed_generation < generation):
        what = "it" if observed_generation is None else f"its current spec (generation {generation})"
        yield Problem(
            type="Accepted",
            reason="NotSeen",
            message=f"The operator has not observed {what} yet. Is it running? kubectl get pods -A -l app.kubernetes.io/name=understudy",
        )


def _is_problem(condition: Condition) -> bool:
    match condition.type:
        case "Degraded" | "Paused" | "DependencyFailed":
            return condition.status == "True"
        case "GateEnforced":
            return condition.status == "False" or condition.reason == SWITCHED_BY_MUX
        case "Recovering":
            return condition.status == "True" or condition.reason not in PAST
        case "Reflex":
            return condition.status == "False" and condition.reason not in ("NoneInControl", "Paused")
    return condition.status == "False"


def _unknown_status(kind: str, item: Object, error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return (
        f"{kind} {item['metadata']['namespace']}/{item['metadata']['name']}: status.{where}: {first['msg']}. "
        "Does this command have the version of the operator?"
    )
