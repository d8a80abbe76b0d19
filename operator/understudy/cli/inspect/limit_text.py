"""The limits that would prevent or delay the recovery of a failure now, as ``understudy explain`` shows them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec, RobotWorkloadStatus
from understudy.api.moments import unix
from understudy.cli.common.robots import Robot
from understudy.failover.decide import Facts, Limit, Occurrence, Trigger, in_force, left
from understudy.failover.limits import budget, cooldown, pause, storm
from understudy.failover.limits.state import ROBOT_AWAY, LimitsInForce
from understudy.kube.client import Object
from understudy.kube.gates.mux_reports import NO_MUX


def limits_in_force(
    spec: RobotWorkloadSpec | None,
    policy: FailurePolicySpec | None,
    policy_item: Object | None,
    status: RobotWorkloadStatus,
    item: Object,
    robot: Robot,
    now: float,
) -> LimitsInForce:
    """Return the limits of a workload that are in force, by its objects. Only the monitor knows its backoff."""
    paused = pause.in_force(spec.pause if spec is not None else None, now)
    reported = status.conditions or []
    away = ROBOT_AWAY if any(one.type == "GateEnforced" and one.reason == NO_MUX for one in reported) else None
    if policy is None:
        return LimitsInForce(pause=paused, away=away)
    limit, guard, last = policy.limits.budget, policy.limits.storm_guard, robot.last_recovery
    recovered = unix(last.ended) if last is not None and last.result == "Recovered" and last.ended is not None else None
    return LimitsInForce(
        pause=paused,
        waiting=cooldown.in_force(policy, recovered, now),
        storm=storm.in_force(guard, policy_item, now) if guard is not None else None,
        budget=budget.in_force(limit, _spent(status), _resumed(item), now) if limit is not None else None,
        away=away,
    )


def sentences(limits: LimitsInForce, name: str, now: float, *, standby_ready: bool) -> Iterator[tuple[str, bool]]:
    """Return a sentence for each limit in force, and whether it prevents or delays the recovery of a failure now."""
    failure, facts = Occurrence(Trigger.HEALTH_FAILED), Facts(now, limits=limits, standby_ready=standby_ready)
    preventing = {one.row.limit for one in in_force(facts, failure)}
    for one in in_force(replace(facts, standby_ready=False), failure):
        consequence = one.row.consequence.format(left=left(one.limit, now))
        text = f"{consequence[0].upper()}{consequence[1:]}: {one.limit.words.rstrip('.')}."
        if one.row.limit in (Limit.PAUSE, Limit.BUDGET):
            text = f"{text} understudy resume {name} ends this."
        yield text, one.row.limit in preventing


def budget_left(
    policy: FailurePolicySpec | None, status: RobotWorkloadStatus, item: Object, now: float
) -> Iterator[str]:
    """Return a sentence with what a budget has left, if some but not all of it is spent."""
    limit = policy.limits.budget if policy is not None else None
    if limit is None:
        return
    counted = budget.counted(_spent(status), _resumed(item), now)
    found = budget.left(counted, now, recoveries=limit.recoveries, within=limit.length)
    if 0 < found < limit.recoveries:
        yield f"limits.budget of its policy ({limit.words}) has {found} left."


def _spent(status: RobotWorkloadStatus) -> list[float]:
    return [moment for moment in map(unix, status.spent or []) if moment is not None]


def _resumed(item: Object) -> float | None:
    return unix((item["metadata"].get("annotations") or {}).get(names.RESUMED, ""))
