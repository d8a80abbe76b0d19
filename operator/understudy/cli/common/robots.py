"""RobotWorkloads and FallbackPools as people ask for them: who drives each robot, whether it is protected, what is wrong.

Everything is taken from what operator and monitor have said in the objects' status; but of a recovery the gate tells first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pydantic import Field, ValidationError

from understudy.api.base import Model
from understudy.api.conditions import Condition
from understudy.api.health_reasons import PAST
from understudy.api.kinds.fallback_pool import FallbackPoolStatus
from understudy.api.kinds.robot_workload import Recovery, RobotWorkloadStatus
from understudy.cli.common.errors import CommandError
from understudy.cli.common.recovery_under_way import UnderWay, under_way
from understudy.cli.common.wording import counted, listed
from understudy.controller.status.protection import LIMIT_CONDITIONS
from understudy.kube.gates.base import GateRecord

Object = Mapping[str, Any]

DRIVEN = ("Healthy", "Degraded")
"""What the health of a robot is that is driven as it should be."""

UNWATCHED = "Unwatched"
"""Instead of the health that a monitor has said last where none is there to say another."""

_UNWATCHED = ("MonitorNotReady", "GateMissing")
"""Reasons of the condition Protected by which nobody watches the robot."""

_ABOUT = {
    "Accepted": "not accepted",
    "Reconciled": "not built as it says",
    "Protected": "not protected",
    "Monitored": "not watched as it says",
    "Healthy": "not healthy",
    "Degraded": "degraded",
    "Recovering": "not recovered",
    "DependencyFailed": "held",
    "DependenciesResolved": "dependencies not followed",
    "GateEnforced": "gate not enforced",
    "OutputsRead": "read past the gate",
    "BroughtUp": "not brought up",
    "Resized": "not resized",
    "Draining": "evictions don't wait",
    "StrategiesChosen": "requirements not met",
    "SituationCovered": "not as its situation asks",
    "Available": "no pod is free",
    "Sized": "too small for its risk",
    "Updated": "not updated",
    "Reflex": "no reflex",
    "StateKept": "state not kept",
    "StateRestored": "state not restored",
    "TasksProxied": "goals not kept",
    "Paused": "paused",
    "WithinBudget": "budget spent",
    "Ready": "not ready",
}
"""What it means where a condition isn't as it should be."""


class Problem(Model):
    """One thing that isn't as it should be."""

    type: str = Field(description="The condition that says so.")
    reason: str = Field(description="One word.")
    message: str = Field(description="What was found, and what would put it right.")
    since: str | None = Field(default=None, description="Since when.")

    @property
    def about(self) -> str:
        """What isn't as it should be, in words."""
        if self.type == "Recovering" and self.reason in ("FailureDetected", "Rescheduling", "FollowsDependency"):
            return "recovering"
        return _ABOUT.get(self.type, self.type)


class LastRecovery(Model):
    """The newest recovery in short."""

    number: int
    result: str
    strategy: str
    reason: str
    planned: bool
    recovery_seconds: float | None
    ended: str | None = None

    @classmethod
    def of(cls, recovery: Recovery) -> LastRecovery:
        """From the record."""
        moments = recovery.moments
        return cls(
            number=recovery.number,
            result=recovery.result,
            strategy=recovery.strategy,
            reason=recovery.reason,
            planned=recovery.planned,
            recovery_seconds=recovery.recovery_seconds,
            ended=moments.verified or moments.routed or moments.detected,
        )


class Robot(Model):
    """One RobotWorkload."""

    namespace: str
    name: str
    policy: str
    created: str | None
    health: str
    """Of the monitor, or UNWATCHED; Recovering also where only its gate tells so."""
    protected: bool
    active: str
    epoch: int
    standby: str
    strategy: str
    """What its monitor would use if it failed now."""
    situation: str
    """Of its policy, that it is in; empty for none."""
    recovery_count: int
    last_recovery: LastRecovery | None
    recovering: UnderWay | None = None
    """The recovery under way, where its gate tells of one."""
    problems: list[Problem]

    @property
    def is_well(self) -> bool:
        """Whether it is protected, and driven as it should be."""
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
        """Whether fewer could take over now than should. A standby that drives its robot is one of those that should be there."""
        return self.ready + (self.claimed if self.readiness != "Uninitialized" else 0) < self.desired


def summary(robots: Sequence[Robot]) -> str:
    """Them all in one line."""
    unprotected = sum(not robot.protected for robot in robots)
    healths = Counter(robot.health for robot in robots)
    told = listed(f"{healths[health]} {health.lower()}" for health in sorted(healths))
    protected = f"{unprotected} not protected" if unprotected else "all protected"
    return f"{counted(len(robots), 'robot')}: {protected}; {told}"


def status_of(item: Object) -> RobotWorkloadStatus:
    """A RobotWorkload's status. Raises CommandError where this command doesn't know what it says."""
    try:
        return RobotWorkloadStatus.model_validate(item.get("status") or {})
    except ValidationError as error:
        raise CommandError(_unknown("RobotWorkload", item, error)) from error


def robot(item: Object, gate: dict[str, Any] | None = None, now: float = 0.0) -> Robot:
    """A RobotWorkload as the API server gives it, with its ``gate`` if known, at ``now`` (unix seconds). Raises CommandError."""
    status, metadata, spec = status_of(item), item["metadata"], item.get("spec") or {}
    said = {condition.type: condition for condition in status.conditions or []}
    protected = said.get("Protected")
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
    """A FallbackPool as the API server gives it. Raises CommandError."""
    try:
        status = FallbackPoolStatus.model_validate(item.get("status") or {})
    except ValidationError as error:
        raise CommandError(_unknown("FallbackPool", item, error)) from error
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
    item: Object, conditions: Iterable[Condition], seen: int | None, recovering: UnderWay | None = None
) -> list[Problem]:
    """What isn't as it should be by an object's conditions, and the recovery under way by its gate.

    ``seen`` is the generation of its spec that the conditions are about.
    """
    found, conditions = list(_unseen(item, seen)), list(conditions)
    if recovering is not None and not _knows_more(conditions, recovering):
        conditions = [condition for condition in conditions if condition.type != "Recovering"]
        reason, message = recovering.occasion, recovering.message
        found.append(Problem(type="Recovering", reason=reason, message=message, since=recovering.since))
    protected = next((c for c in conditions if c.type == "Protected" and c.status == "False"), None)
    gate = next((c.reason for c in conditions if c.type == "GateEnforced" and c.status == "False"), "")
    for condition in conditions:
        if not _amiss(condition):
            continue
        same = protected is not None and protected.reason == condition.reason
        if condition.type == "Reconciled" and (same or condition.reason == "NotAccepted"):
            continue  # it is told already
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


def is_told(problem: Problem, messages: Iterable[str]) -> bool:
    """Whether a pool's problem is one of a pod, of which one of these messages tells already."""
    cause = problem.message.partition("; ")[2].rstrip(".")
    return bool(cause) and any(cause in message for message in messages)


def _knows_more(conditions: Iterable[Condition], recovering: UnderWay) -> bool:
    """Whether the status says more of a recovery than that it is under way, such as for whom else it waits."""
    said = next((condition for condition in conditions if condition.type == "Recovering"), None)
    return said is not None and said.status == "True" and said.reason != recovering.occasion


def _unseen(item: Object, seen: int | None) -> Iterator[Problem]:
    generation = item["metadata"].get("generation")
    if seen is None or (generation is not None and seen < generation):
        what = "it" if seen is None else f"its present spec (generation {generation})"
        yield Problem(
            type="Accepted",
            reason="NotSeen",
            message=f"The operator has not looked at {what} yet. Is it running? kubectl get pods -A -l app.kubernetes.io/name=understudy",
        )


def _amiss(condition: Condition) -> bool:
    match condition.type:
        case "Degraded" | "Paused" | "DependencyFailed":
            return condition.status == "True"
        case "Recovering":
            return condition.status == "True" or condition.reason not in PAST
        case "Reflex":
            return condition.status == "False" and condition.reason not in ("NoneInControl", "Paused")
    return condition.status == "False"


def _unknown(kind: str, item: Object, error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return (
        f"{kind} {item['metadata']['namespace']}/{item['metadata']['name']}: status.{where}: {first['msg']}. "
        "Is this command as new as the operator?"
    )
