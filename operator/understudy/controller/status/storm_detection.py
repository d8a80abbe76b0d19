"""Detects storms: so many workloads of a policy fail at once that the network or the cluster is the likely cause.

The limits are in limits.stormGuard. The result is a condition of the policy, which the monitors watch anyway: one write
for a whole fleet. No monitor waits for the condition. Until a monitor has received it, the monitor acts as if there were
no storm. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime

from understudy.api.base import seconds
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.failure_policy import StormGuard
from understudy.controller.observed import committed_recovery, degraded_measures, kube_objects
from understudy.kube.client import Object

CONDITION = "Storm"

FAILING = ("Failed", "Recovering")
"""Values of a failing workload's health."""

NAMED = 5
"""Maximum number of workloads in a message."""


def health(workload: Object) -> str:
    """Return the health that a workload's monitor reports."""
    found: str = (workload.get("status") or {}).get("health") or ""
    return found


def counted_until(workload: Object, gate: Object | None, now: float, within: float) -> float | None:
    """Return until when a workload counts as failing, in Unix seconds; None if it does not count.

    It is infinity if the workload fails now. The gate shows a failure first. The status shows it after the recovery, or
    if the recovery takes long.
    """
    if health(workload) in FAILING:
        return float("inf")
    moments = []
    recoveries = (workload.get("status") or {}).get("recoveries") or []
    moment = (recoveries[0].get("moments") or {}).get("detected") if recoveries else None
    if moment is not None and not recoveries[0].get("planned"):
        moments.append(datetime.fromisoformat(moment).timestamp())
    beside = committed_recovery.beside(gate)
    if beside is not None and not beside.planned:
        moments.append(beside.detected)
    until = max(moments, default=-math.inf) + within
    return until if now < until else None


def judge(
    policy: Object, guard: StormGuard, workloads: Sequence[tuple[Object, Object | None]], now: float
) -> tuple[Condition, float | None]:
    """Return the policy's condition for storms, and the seconds until time alone may change it.

    ``workloads`` are all workloads of the policy, each with its gate.
    """
    awake = [(workload, gate) for workload, gate in workloads if not degraded_measures.paused(workload)]
    until = {kube_objects.name(w): counted_until(w, gate, now, seconds(guard.within)) for w, gate in awake}
    failing = sorted(name for name, moment in until.items() if moment is not None)
    passing = [moment for moment in until.values() if moment is not None and moment != float("inf")]
    again = max(0.0, min(passing) - now) if passing else None
    if len(failing) < guard.workloads or 100 * len(failing) <= guard.percent * len(awake):
        text = (
            f"Fewer workloads fail than limits.stormGuard needs: at least {guard.workloads} at the same time, and more than "
            f"{guard.percent} % of the workloads of this policy."
        )
        return condition(CONDITION, False, "FewFail", text), again
    live = (policy.get("status") or {}).get("conditions") or []
    before = next((c for c in live if (c["type"], c["status"]) == (CONDITION, "True")), None)
    # The text from the start of the storm, because every monitor receives each change of it.
    text = before["message"] if before is not None else _words(failing, len(awake), guard)
    return condition(CONDITION, True, "ManyFail", text), again


def _words(failing: Sequence[str], of: int, guard: StormGuard) -> str:
    more = f" and {len(failing) - NAMED} more" if len(failing) > NAMED else ""
    return (
        f"{len(failing)} of {of} workloads fail now or failed within {guard.within}: {', '.join(failing[:NAMED])}{more}. The cause is "
        f"probably the network or the cluster. Recoveries without a ready standby are deferred until fewer fail, for at "
        f"most {guard.hold_for}."
    )
