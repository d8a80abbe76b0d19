"""The status of FailurePolicies: whether they are valid, and their summary."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from understudy.api.conditions import Condition, condition, summary
from understudy.api.kinds.fallback_pool import SHARED_NAMES, STANDBY_NAMES
from understudy.controller.observed import kube_objects, policy_reader, pool_reader, situation_strategies
from understudy.controller.plan import Problem
from understudy.kube.client import Object


def in_short(policy: Object, pools: Mapping[str, Object]) -> str:
    """Return the strategies in order, such as ``Executing, Restart``; ``Auto`` if they are selected for each workload."""
    listed = []
    for strategy in (policy.get("spec") or {}).get("strategies") or []:
        pool = (strategy.get("poolRef") or {}).get("name", "")
        if strategy.get("type") != "Fallback":
            listed.append(strategy.get("type", ""))
        else:
            listed.append(pool_reader.readiness(pools[pool]) if pool in pools else f"Fallback/{pool}")
    return ", ".join(listed)


def conditions(policy: Object, pools: Mapping[str, Object], config_maps: Mapping[str, Object]) -> list[Condition]:
    """Return the policy's condition Accepted."""
    found = policy_reader.problem(policy, config_maps)
    if found is None:
        found = _unfound(policy, pools)
    if found is None:
        found = _prewarm_problem(policy, pools) or _wait_problem(policy, pools)
    if found is not None:
        return [condition("Accepted", False, found.reason, found.message)]
    return [condition("Accepted", True, "Accepted", "The spec is valid.")]


def _unfound(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    """Return the problem of a pool that the policy names and that does not exist, or None."""
    listed = enumerate((policy.get("spec") or {}).get("strategies") or [])
    always = [(f"spec.strategies[{i}].poolRef.name", (one.get("poolRef") or {}).get("name")) for i, one in listed]
    for path, name in (*always, *situation_strategies.pool_paths(policy)):
        if name and name not in pools:
            return Problem(
                "PoolNotFound",
                f'{path}: FallbackPool "{name}" is not in namespace {policy["metadata"]["namespace"]} '
                f"({kube_objects.hint(name, pools)}). Create it, or correct the name; until then that strategy is skipped",
            )
    return None


def _prewarm_problem(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    degraded = policy_reader.spec(policy).degraded
    for index, action in enumerate(degraded.actions if degraded is not None else ()):
        name = action.prewarm.pool_ref.name if action.prewarm is not None else ""
        if name in pools and pool_reader.is_shared(pools[name]):
            return Problem("PoolNotPrewarmed", f"spec.degraded.actions[{index}].prewarm.poolRef.name: {shared(name)}")
    return None


def shared(pool: str) -> str:
    """Return why a pool cannot be pre-warmed for a workload."""
    return (
        f"FallbackPool {pool} has readiness {SHARED_NAMES}, so its pods belong to no workload. Name a pool with readiness {STANDBY_NAMES} "
        f"(with perWorkload 0 it has no pods until a workload is degraded)"
    )


def _wait_problem(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    for path, strategy in policy_reader.spec(policy).everywhere:
        name = strategy.pool_ref.name if strategy.pool_ref is not None else ""
        if strategy.wait_for is not None and name in pools and not pool_reader.is_shared(pools[name]):
            text = unshared(name, pool_reader.readiness(pools[name]))
            return Problem("PoolNotShared", f"spec.{path}.waitFor: {text}")
    return None


def unshared(pool: str, readiness: str) -> str:
    """Return why no workload waits for a pod of a pool."""
    return (
        f"FallbackPool {pool} is {readiness}, so each workload has its own standbys and none to wait for. Remove waitFor, or "
        f"name a pool that is {SHARED_NAMES}"
    )


def status(
    policy: Object,
    *,
    pools: Mapping[str, Object],
    config_maps: Mapping[str, Object],
    users: Collection[str],
    storm: Condition | None = None,
) -> Object:
    """Return the policy's status, without the times of its conditions.

    ``storm`` is its condition for storms, if it has a guard.
    """
    accepted = conditions(policy, pools, config_maps)
    tree = policy_reader.tree_in_force(policy, config_maps)
    return {
        "workloads": len(users),
        "strategies": in_short(policy, pools),
        **({"tree": tree} if tree is not None else {}),
        **kube_objects.status(
            policy, (summary(accepted, ["Accepted"]), *accepted, *([storm] if storm is not None else []))
        ),
    }
