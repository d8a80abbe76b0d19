"""Reads from the policy's status whether there is a storm (limits.stormGuard). The status is read only after a failure."""

from __future__ import annotations

from understudy.failover.limits import storm
from understudy.failover.limits.state import ActiveLimit
from understudy.monitor.observe.objects.cluster_view import ClusterView


class StormCondition:
    """The storms of one workload's policy."""

    def __init__(self, view: ClusterView) -> None:
        self._view = view

    def on(self, now: float) -> ActiveLimit | None:
        """Return the storm at this time (Unix seconds); None if there is none, or if it has lasted for too long."""
        policy, spec = self._view.policy, self._view.spec
        if policy is None or spec is None or (guard := policy.limits.storm_guard) is None:
            return None
        return storm.in_force(guard, self._view.policies.items.get(spec.failure_policy_ref.name), now)
