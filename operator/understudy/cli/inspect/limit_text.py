"""What would keep a failure from being recovered at once: a pause, a budget that is spent, a cooldown; pure."""

from __future__ import annotations

from collections.abc import Iterator

from understudy.api import names
from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.pause_spec import in_words, unix
from understudy.api.kinds.robot_workload import RobotWorkloadSpec, RobotWorkloadStatus
from understudy.cli.common.robots import Robot
from understudy.failover.limits import budget as budgets
from understudy.kube.client import Object

Told = tuple[str, bool]
"""A sentence, and whether it puts a recovery off."""


def paused(spec: RobotWorkloadSpec | None, now: float) -> Iterator[Told]:
    """By whom and why the workload is to be left alone."""
    if spec is not None and spec.pause is not None and spec.pause.in_force(now):
        yield f"Nothing would be done, it is {spec.pause.words} (spec.pause).", True


def spent(policy: FailurePolicySpec | None, status: RobotWorkloadStatus, item: Object, now: float) -> Iterator[Told]:
    """What limits.budget has left."""
    budget = policy.limits.budget if policy is not None else None
    if budget is None:
        return
    resumed = unix((item["metadata"].get("annotations") or {}).get(names.RESUMED, ""))
    moments = [moment for moment in map(unix, status.spent or []) if moment is not None]
    counted = budgets.counted(moments, resumed, now)
    free = budgets.free_from(counted, recoveries=budget.recoveries, within=budget.length)
    if now < free:
        yield (
            f"It would be fenced, and nothing else would be done before {in_words(free)}: the {budget.words} of limits.budget were made. "
            f"understudy resume {item['metadata']['name']} begins anew.",
            True,
        )
        return
    left = budgets.left(counted, now, recoveries=budget.recoveries, within=budget.length)
    if left < budget.recoveries:
        yield f"limits.budget of its policy ({budget.words}) has {left} left.", False


def storm(policy: Object | None) -> Iterator[Told]:
    """Whether so many others fail that it would be held."""
    for said in ((policy or {}).get("status") or {}).get("conditions") or []:
        if (said["type"], said["status"]) == ("Storm", "True"):
            yield f"Unless a standby took over, it would be held by limits.stormGuard: {said['message']}", True


def cooling_down(policy: FailurePolicySpec | None, said: Robot, now: float) -> Iterator[Told]:
    """How long limits.cooldown puts the next recovery off."""
    last = said.last_recovery
    if policy is None or policy.priority == "Safety" or last is None or last.ended is None:
        return
    ended = unix(last.ended)
    if last.result != "Recovered" or ended is None:
        return
    pause = seconds(policy.limits.cooldown)
    # By another machine's clock a recovery may seem to be of the future: no wait is longer than it can be.
    left = min(pause, ended + pause - now)
    if left > 0:
        yield (
            f"Nothing would be done for another {left:.0f} s: limits.cooldown of its policy asks for {policy.limits.cooldown} after a "
            "recovery.",
            True,
        )
