"""FailurePolicies: whether they can be followed, and how they read in short."""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Iterator, Mapping

from pydantic import ValidationError

from understudy.api.base import seconds
from understudy.api.conditions import Condition, condition
from understudy.api.kinds.failure_policy import FailurePolicySpec, StormGuard
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.tree_spec import Written
from understudy.controller.observed import health_tree_sources, kube_objects, situation_strategies
from understudy.controller.plan import Problem
from understudy.kube.client import Object
from understudy.trees.languages.notations import load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.problems import TreeError

_MOST_PROBLEMS = 10


def spec(policy: Object) -> FailurePolicySpec:
    """The policy's spec. Raises ValidationError where a stored one doesn't fit the present kind."""
    return FailurePolicySpec.model_validate(policy.get("spec") or {})


def invalid(error: ValidationError) -> str:
    """What doesn't fit a kind, field by field."""
    return "; ".join(
        f"spec.{'.'.join(str(part) for part in found['loc'])}: {found['msg']}"
        for found in error.errors()[:_MOST_PROBLEMS]
    )


def problem(policy: Object, config_maps: Mapping[str, Object]) -> Problem | None:
    """Why a policy can't be followed, or None. Missing pools don't count: the next strategy is used then.

    ``config_maps`` are those of its namespace.
    """
    try:
        parsed = spec(policy)
    except ValidationError as error:
        return Problem("SpecInvalid", invalid(error))
    tree = health_tree_sources.find(parsed.monitoring, config_maps, policy["metadata"]["namespace"])
    if isinstance(tree, Problem):
        return tree
    grace = seconds(parsed.monitoring.startup_grace)
    if tree is None and (found := _tree_problem(parsed.monitoring.form, json.dumps(parsed.monitoring.tree), grace)):
        return Problem("TreeInvalid", found)
    for path, inline in _inline_trees(parsed):
        if found := _inline_problem(inline, path, grace):
            return Problem("TreeInvalid", found)
    if found := procedures_problem(*((f"spec.{path}", recovery) for path, recovery in parsed.recoveries)):
        return Problem("TreeInvalid", found)
    return None


def pool_problem(pool: Object) -> Problem | None:
    """Why a pool can't be followed, as far as its own spec says; None if it can."""
    try:
        parsed = pool_spec(pool)
    except ValidationError as error:
        return Problem("SpecInvalid", invalid(error))
    if found := procedures_problem(
        ("spec.initialization", parsed.initialization), ("spec.readinessCheck", parsed.readiness_check)
    ):
        return Problem("TreeInvalid", found)
    return None


def procedures_problem(*found: tuple[str, Procedure | Check | None]) -> str | None:
    """What is wrong with procedures and checks, each with its path; None where nothing is."""
    problems = [
        problem
        for path, tree in found
        if tree is not None
        and (problem := _procedure_problem(tree.form, json.dumps(tree.tree), path, isinstance(tree, Check))) is not None
    ]
    return "; ".join(problems) or None


@functools.lru_cache(maxsize=512)
def _procedure_problem(form: str, tree: str, path: str, is_check: bool) -> str | None:
    try:
        compose(form, json.loads(tree), check=is_check, path=f"{path}.{form}")
    except TreeError as error:
        return error.in_short()
    return None


@functools.lru_cache(maxsize=512)
def _tree_problem(form: str, tree: str, grace: float, path: str | None = None) -> str | None:
    try:
        load_health(form, json.loads(tree), grace=grace, path=path)
    except TreeError as error:
        return error.in_short()
    return None


def _inline_trees(parsed: FailurePolicySpec) -> Iterator[tuple[str, Written]]:
    """The trees of ``spec.situations`` and ``spec.degraded`` with their paths."""
    for index, situation in enumerate(parsed.situations):
        if situation.when.given:
            yield f"spec.situations[{index}].when", situation.when
    if parsed.degraded is None:
        return
    yield "spec.degraded.monitoring", parsed.degraded.monitoring
    for index, action in enumerate(parsed.degraded.actions):
        if action.reschedule is not None and action.reschedule.idle is not None:
            yield f"spec.degraded.actions[{index}].reschedule.idle", action.reschedule.idle


def _inline_problem(tree: Written, path: str, grace: float) -> str | None:
    return _tree_problem(tree.form, json.dumps(tree.tree), grace, f"{path}.{tree.form}")


def named_pools(policy: Object) -> list[str]:
    """The pools that the policy's strategies name, in order, and then those of its situations."""
    strategies = (policy.get("spec") or {}).get("strategies") or []
    always = [s["poolRef"]["name"] for s in strategies if (s.get("poolRef") or {}).get("name")]
    return [*always, *situation_strategies.named_pools(policy)]


def readiness(pool: Object) -> str:
    """The pool's readiness."""
    found: str = (pool.get("spec") or {}).get("readiness", "")
    return found


def pool_spec(pool: Object) -> FallbackPoolSpec:
    """A pool's spec. Raises ValidationError where a stored one doesn't fit the present kind."""
    return FallbackPoolSpec.model_validate(pool.get("spec") or {})


def in_short(policy: Object, pools: Mapping[str, Object]) -> str:
    """The strategies in order, such as ``Executing, Restart``; ``Auto`` where they are chosen for each workload."""
    told = []
    for strategy in (policy.get("spec") or {}).get("strategies") or []:
        if strategy.get("type") in ("Restart", "Auto"):
            told.append(strategy["type"])
            continue
        pool = (strategy.get("poolRef") or {}).get("name", "")
        told.append(readiness(pools[pool]) if pool in pools else f"Fallback/{pool}")
    return ", ".join(told)


def conditions(policy: Object, pools: Mapping[str, Object], config_maps: Mapping[str, Object]) -> list[Condition]:
    """The policy's Accepted condition."""
    generation = kube_objects.generation(policy)
    found = problem(policy, config_maps)
    if found is None:
        found = _unfound(policy, pools)
    if found is None:
        found = _prewarm_problem(policy, pools) or _wait_problem(policy, pools)
    if found is not None:
        return [condition("Accepted", False, found.reason, found.message, generation=generation)]
    return [condition("Accepted", True, "Accepted", "It can be followed.", generation=generation)]


def _unfound(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    """A pool that is named and isn't there."""
    listed = enumerate((policy.get("spec") or {}).get("strategies") or [])
    always = [(f"spec.strategies[{i}].poolRef.name", (one.get("poolRef") or {}).get("name")) for i, one in listed]
    for path, name in (*always, *situation_strategies.pool_paths(policy)):
        if name and name not in pools:
            return Problem(
                "PoolNotFound",
                f'{path}: FallbackPool "{name}" is not in namespace {policy["metadata"]["namespace"]} '
                f"({kube_objects.hint(name, pools)}). Create it, or correct the name; until then that strategy is passed over",
            )
    return None


def _prewarm_problem(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    degraded = spec(policy).degraded
    for index, action in enumerate(degraded.actions if degraded is not None else ()):
        name = action.prewarm.pool_ref.name if action.prewarm is not None else ""
        if name in pools and readiness(pools[name]) == "Uninitialized":
            return Problem("PoolNotPrewarmed", f"spec.degraded.actions[{index}].prewarm.poolRef.name: {shared(name)}")
    return None


def shared(pool: str) -> str:
    """Why a pool can't be pre-warmed for a workload."""
    return (
        f"FallbackPool {pool} is Uninitialized, so its pods are of no workload's own; name one that is Initialized or Executing "
        f"(with perWorkload 0 it costs nothing until a workload is degraded)"
    )


def _wait_problem(policy: Object, pools: Mapping[str, Object]) -> Problem | None:
    for path, strategy in spec(policy).everywhere:
        name = strategy.pool_ref.name if strategy.pool_ref is not None else ""
        if strategy.wait_for is not None and name in pools and readiness(pools[name]) != "Uninitialized":
            text = unshared(name, readiness(pools[name]))
            return Problem("PoolNotShared", f"spec.{path}.waitFor: {text}")
    return None


def unshared(pool: str, readiness: str) -> str:
    """Why nobody waits for a pod of a pool."""
    return (
        f"FallbackPool {pool} is {readiness}, so each workload has standbys of its own and none to wait for; leave waitFor out, or "
        f"name a pool that is Uninitialized"
    )


def tree_in_force(policy: Object, config_maps: Mapping[str, Object]) -> Object | None:
    """The health tree that monitors go by where it comes from a ConfigMap: while that has no good one, the last that was."""
    try:
        found = health_tree_sources.find(spec(policy).monitoring, config_maps, policy["metadata"]["namespace"])
    except ValidationError:
        found = Problem("SpecInvalid", "told elsewhere")
    if isinstance(found, Problem):
        last: Object | None = (policy.get("status") or {}).get("tree")
        return last
    return found.to_wire() if found is not None else None


def status(
    policy: Object,
    *,
    pools: Mapping[str, Object],
    config_maps: Mapping[str, Object],
    users: Collection[str],
    storm: Condition | None = None,
) -> Object:
    """The policy's status, but for the times of its conditions. ``storm`` is what is said of one, where it is guarded against."""
    tree = tree_in_force(policy, config_maps)
    return {
        "observedGeneration": kube_objects.generation(policy),
        "workloads": len(users),
        "strategies": in_short(policy, pools),
        **({"tree": tree} if tree is not None else {}),
        "conditions": [
            c.to_wire() for c in (*conditions(policy, pools, config_maps), *([storm] if storm is not None else []))
        ],
    }


def storm_guard(policy: Object) -> StormGuard | None:
    """What it says of storms; None where it says nothing, or doesn't fit the present kind."""
    given = ((policy.get("spec") or {}).get("limits") or {}).get("stormGuard")
    if not given:
        return None  # nothing to parse for the many that have none
    try:
        return StormGuard.model_validate(given)
    except ValidationError:
        return None
