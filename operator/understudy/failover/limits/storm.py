"""Detects that so many workloads of a policy fail at once that the network or the cluster is the likely cause (limits.stormGuard); pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import StormGuard
from understudy.api.moments import unix
from understudy.failover.limits.state import ActiveLimit

CONDITION = "Storm"


def in_force(guard: StormGuard, policy: Mapping[str, Any] | None, now: float) -> ActiveLimit | None:
    """Return the storm that the status of a policy object reports, until ``holdFor`` has passed."""
    for condition in ((policy or {}).get("status") or {}).get("conditions") or []:
        if (condition["type"], condition["status"]) == (CONDITION, "True"):
            since = unix(condition["lastTransitionTime"])
            if since is None or now >= since + seconds(guard.hold_for):
                return None
            return ActiveLimit(condition["message"], since + seconds(guard.hold_for))
    return None
