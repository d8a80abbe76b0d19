"""What a policy asks for while a workload is degraded, as the operator reads it. Whether it is degraded the monitor says."""

from __future__ import annotations

from pydantic import ValidationError

from understudy.api.kinds.degraded_spec import Action
from understudy.controller.observed import policy_reader
from understudy.kube.client import Object


def degraded(workload: Object) -> bool:
    """Whether a workload's monitor says that it is degraded.

    By the condition, which stays while the workload fails and recovers: what was made ready for that moment is there in it.
    """
    conditions = (workload.get("status") or {}).get("conditions") or []
    return any(c["type"] == "Degraded" and c["status"] == "True" for c in conditions)


def paused(workload: Object) -> bool:
    """Whether a workload's monitor says that it is to be left alone."""
    conditions = (workload.get("status") or {}).get("conditions") or []
    return any(c["type"] == "Paused" and c["status"] == "True" for c in conditions)


def actions(policy: Object | None) -> list[Action]:
    """The actions of a policy; none where it has none, or doesn't fit the present kind."""
    if not ((policy or {}).get("spec") or {}).get("degraded"):
        return []  # nothing to parse for the many that have none
    assert policy is not None
    try:
        found = policy_reader.spec(policy).degraded
    except ValidationError:
        return []
    return found.actions if found is not None else []


def prewarms(policy: Object | None) -> list[str]:
    """The pools of which a policy wants a standby more while a workload is degraded."""
    return [action.prewarm.pool_ref.name for action in actions(policy) if action.prewarm is not None]


def prewarmed(workload: Object, policy: Object | None, pool: str) -> bool:
    """Whether a workload is to have a standby more of a pool now."""
    return degraded(workload) and pool in prewarms(policy)
