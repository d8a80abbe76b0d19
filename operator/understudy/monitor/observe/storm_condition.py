"""Whether a storm is on by what the operator says in the policy (limits.stormGuard): asked only once something has failed."""

from __future__ import annotations

from understudy.api.base import seconds
from understudy.api.kinds.pause_spec import unix
from understudy.monitor.observe.cluster_view import View

CONDITION = "Storm"


class Storms:
    """The storms of one workload's policy."""

    def __init__(self, view: View) -> None:
        self._view = view

    def on(self, now: float) -> str | None:
        """What is said of the storm that is on at this time (unix seconds); None where none is, or it has been for too long."""
        policy, spec = self._view.policy, self._view.spec
        if policy is None or spec is None or (guard := policy.limits.storm_guard) is None:
            return None
        item = self._view.policies.items.get(spec.failure_policy_ref.name) or {}
        for said in (item.get("status") or {}).get("conditions") or []:
            if (said["type"], said["status"]) == (CONDITION, "True"):
                since = unix(said["lastTransitionTime"])
                over = since is None or now >= since + seconds(guard.hold_for)
                return None if over else said["message"]
        return None
