"""The size of a shared pool: given by its spec, or calculated from the failures of its robots.

All input is in statuses: the failures in those of the workloads, which their monitors write at a recovery, and the
current size in the pool's own. So nothing is written for healthy robots, and another operator can continue at any time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from understudy.advice.adaptive_size import COUNTED, REST, CurrentSize, Decision, SizingTarget, decide_size
from understudy.advice.failure_rate import SURE, Rate, estimate_rate
from understudy.api.base import fraction, seconds
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.fallback_pool import LEVELS, FallbackPoolSpec, Sizing, SizingStatus
from understudy.api.moments import unix
from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

CONDITION = "Sized"
SHORT = "AtMaximum"
"""Reason of the condition if more pods are needed than the maximum."""
RECALCULATE_AFTER = 60.0
"""Seconds after which the size is calculated again without any change: the absence of failures is information too."""

_HOUR = 3600.0
_LITTLE = 0.1
"""Figures that change only with time are not written again while the rate has changed by at most this share."""
_SHARED = frozenset(f"Fallback/{name}" for name, level in LEVELS.items() if level.shared)
"""The strategies that use a shared pool's pod, as named in the record of a recovery."""


@dataclass(frozen=True)
class RobotHistory:
    """The observations of the robots that share a pool."""

    robots: int = 0
    failures: int = 0
    hours: float = 0.0


@dataclass(frozen=True)
class Sized:
    """A pool's size with all figures from which it was calculated."""

    spec: Sizing
    rate: Rate
    decision: Decision
    status: SizingStatus
    before: CurrentSize | None
    short: bool
    """Whether its maximum is too small for the risk."""


def size(pool: Object) -> int:
    """Return how many unclaimed pods a shared pool should hold, as last decided."""
    spec = pool.get("spec") or {}
    sizing = spec.get("sizing")
    if sizing is None:
        return spec.get("replicas") or 0
    held = _held(pool)
    least: int = Sizing.model_fields["min"].default
    return held.size if held is not None else sizing.get("min", least)


def wanted(spec: FallbackPoolSpec, sized: Sized | None) -> int:
    """Return how many unclaimed pods a shared pool should hold now."""
    return sized.decision.size if sized is not None else spec.replicas or 0


def sized(pool: Object, spec: FallbackPoolSpec, asking: Sequence[Object], now: float) -> Sized | None:
    """Return the size that follows from the failures of the workloads that claim from a pool.

    It is None if the pool's spec gives the size.
    """
    sizing = spec.sizing
    if sizing is None:
        return None
    found = robot_history(kube_objects.name(pool), asking, now - seconds(sizing.history), now)
    rate = estimate_rate(sizing.failures_per_robot_hour, found.failures, found.hours)
    aim = SizingTarget(
        risk=fraction(sizing.risk),
        measure=sizing.risk_of.lower(),
        refill=seconds(sizing.refill),
        least=sizing.min,
        most=sizing.max,
        kept_back=spec.reserve.pods if spec.reserve is not None else 0,
    )
    before = _held(pool)
    decision = decide_size(aim, found.robots, rate, before, now)
    status = _settled(_stored(pool), _status(found, rate, decision))
    # Like the size, this report stays until it is certain that it no longer applies.
    short = decision.needed > sizing.max or (_was_short(pool) and decision.safe > sizing.max)
    return Sized(sizing, rate, decision, status, before, short)


def robot_history(pool: str, asking: Iterable[Object], begin: float, now: float) -> RobotHistory:
    """Return how often workloads asked for a pod of a pool since ``begin``, and for how many hours they were observed."""
    robots, failures, hours = 0, 0, 0.0
    for workload in asking:
        since = max(begin, kube_objects.created(workload))
        status = workload.get("status") or {}
        recoveries: list[Object] = status.get("recoveries") or []
        if (status.get("recoveryCount") or 0) > len(recoveries) and recoveries:
            # The status keeps only some recoveries, and earlier ones are unknown. So the observation starts at the
            # oldest one that is left.
            since, recoveries = max(since, _when(recoveries[-1])), recoveries[:-1]
        robots += 1
        failures += sum(since < _when(one) <= now and _asked(pool, one) for one in recoveries)
        hours += max(0.0, now - since) / _HOUR
    return RobotHistory(robots, failures, hours)


def _when(recovery: Object) -> float:
    """Return when a failure was detected, in Unix seconds; 0 if unknown."""
    return unix((recovery.get("moments") or {}).get("detected")) or 0.0


def _asked(pool: str, recovery: Object) -> bool:
    """Whether a recovery claimed a pod of a pool, or would have if there had been one.

    A pod's name starts with that of its pool. If no pod was available, the recovery may have asked another shared pool
    as well.
    """
    tried = [one for one in recovery.get("attempts") or [] if one.get("strategy") in _SHARED]
    return any(not one.get("pod") or one["pod"].rpartition("-")[0] == pool for one in tried)


def _stored(pool: Object) -> dict[str, Any]:
    """Return the sizing part of the pool's status; empty if there is none."""
    found: dict[str, Any] = (pool.get("status") or {}).get("sizing") or {}
    return found


def _held(pool: Object) -> CurrentSize | None:
    """Return the size that was last decided, or None."""
    found = _stored(pool)
    return CurrentSize(found["size"], datetime.fromisoformat(found["lastChange"]).timestamp()) if found else None


def _was_short(pool: Object) -> bool:
    conditions = (pool.get("status") or {}).get("conditions") or []
    return any(one["type"] == CONDITION and one["reason"] == SHORT for one in conditions)


def last(pool: Object) -> Object:
    """Return the last reported size, for a pool whose spec is invalid."""
    known = _stored(pool)
    return {"sizing": known} if known else {}


def status(found: Sized) -> Object:
    """Return the size part of the status."""
    return {"sizing": found.status.to_wire()}


def _status(of: RobotHistory, rate: Rate, decision: Decision) -> SizingStatus:
    return SizingStatus(
        size=decision.size,
        last_change=datetime.fromtimestamp(decision.since, UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        needed=decision.needed,
        robots=of.robots,
        failures=of.failures,
        robot_hours=_figure(of.hours),
        failures_per_robot_hour=_figure(rate.expected),
        low=_figure(rate.low),
        high=_figure(rate.high),
    )


def _settled(stored: Object, new: SizingStatus) -> SizingStatus:
    """Return the new figures, or the stored ones if only time has passed.

    Time always passes, so they would always be written.
    """
    if not stored:
        return new
    old = SizingStatus.model_validate(stored)
    passing = {"robot_hours", "failures_per_robot_hour", "low", "high"}
    same = old.model_dump(exclude=passing) == new.model_dump(exclude=passing)
    change = abs(new.failures_per_robot_hour - old.failures_per_robot_hour)
    return old if same and change <= _LITTLE * old.failures_per_robot_hour else new


def judged(found: Sized) -> Condition:
    """Return the condition with the number of pods and its reasons."""
    decision, spec = found.decision, found.spec
    if found.short:
        message = (
            f"{_reason(found)} This needs {_pods(decision.needed)}, but spec.sizing.max is {spec.max}: "
            "increase it, or allow a higher spec.sizing.risk."
        )
        return condition(CONDITION, False, SHORT, message)
    return condition(CONDITION, True, CONDITION, f"{_reason(found)} {_conclusion(found)}")


def _reason(found: Sized) -> str:
    """Return the rate and its source, as text."""
    spec, status = found.spec, found.status
    robots = "1 robot" if status.robots == 1 else f"{status.robots} robots"
    hours = "1 robot hour" if status.robot_hours == 1 else f"{status.robot_hours:g} robot hours"
    times = "once" if status.failures == 1 else f"{status.failures} times"
    requests = f"a pod {times}" if status.failures else "no pod"
    kind = "find no pod" if spec.risk_of == "Loss" else "have to wait for a pod"
    return (
        f"{robots} requested {requests} in {hours}. With the prior of {spec.failures_per_robot_hour:g} per robot and hour "
        f"(spec.sizing.failuresPerRobotHour), the estimated rate is {status.failures_per_robot_hour:g} ({2 * SURE - 1:.0%} interval: "
        f"{status.low:g} to {status.high:g}). A replacement pod is ready {spec.refill} after each request (spec.sizing.refill). "
        f"At most {spec.risk} of the requests may {kind} (spec.sizing.risk)."
    )


def _conclusion(found: Sized) -> str:
    decision, spec = found.decision, found.spec
    size = f"So the pool keeps {_pods(decision.size)}"
    if decision.size > decision.needed and decision.size == spec.min:
        return f"{size}, which is spec.sizing.min; {_pods(decision.needed)} would be enough."
    if decision.shrinks and decision.size > spec.min:
        fewer = max(decision.safe, spec.min)
        return (
            f"{size}. {_pods(fewer)} would be enough with {SURE:.0%} confidence, so the operator removes one pod every "
            f"{REST / 60:g} minutes."
        )
    if decision.size > decision.needed:
        return f"{size}. At the estimated rate, {_pods(decision.needed)} would be enough, but not yet with {SURE:.0%} confidence."
    return f"{size}."


def change(found: Sized) -> str | None:
    """Return the text of the Event for a changed size; None if the size has not changed."""
    if found.before is None or found.before.size == found.decision.size:
        return None
    return f"from {found.before.size} to {found.decision.size} pods: {_reason(found)}"


def _pods(number: int) -> str:
    return f"{COUNTED} pods or more" if number >= COUNTED else "1 pod" if number == 1 else f"{number} pods"


def _figure(value: float) -> float:
    return float(f"{value:.2g}")
