"""The actions of a policy for a degraded workload, as the operator reads them.

The monitor determines whether it is degraded.
"""

from __future__ import annotations

from pydantic import ValidationError

from understudy.api.kinds.degraded_spec import Action
from understudy.controller.observed import policy_reader
from understudy.kube.client import Object


def degraded(workload: Object) -> bool:
    """Whether a workload's monitor reports that it is degraded.

    This function reads the condition, which stays while the workload fails and recovers: the standby that was prepared
    for that moment is then in use.
    """
    conditions = (workload.get("status") or {}).get("conditions") or []
    return any(c["type"] == "Degraded" and c["status"] == "True" for c in conditions)


def paused(workload: Object) -> bool:
    """Whether a workload's monitor reports that it is paused."""
    conditions = (workload.get("status") or {}).get("conditions") or []
    return any(c["type"] == "Paused" and c["status"] == "True" for c in conditions)


def actions(policy: Object | None) -> list[Action]:
    """Return the actions of a policy; empty if it has none or is invalid."""
    if not ((policy or {}).get("spec") or {}).get("degraded"):
        return []  # most policies have none, so there is nothing to parse
    assert policy is not None
    try:
        found = policy_reader.spec(policy).degraded
    except ValidationError:
        return []
    return found.actions if found is not None else []


def prewarms(policy: Object | None) -> list[str]:
    """Return the pools of which a policy adds a standby while a workload is degraded."""
    return [action.prewarm.pool_ref.name for action in actions(policy) if action.prewarm is not None]


def prewarmed(workload: Object, policy: Object | None, pool: str) -> bool:
    """Whether a workload should have an additional standby of a pool now."""
    return degraded(workload) and pool in prewarms(policy)
