"""FailurePolicies: whether they can be followed, and how they read in short."""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Mapping

from pydantic import ValidationError

from understudy.api.base import seconds
from understudy.api.conditions import Condition, condition
from understudy.api.policies import FailurePolicySpec
from understudy.api.pools import FallbackPoolSpec
from understudy.api.procedures import Check, Procedure
from understudy.cluster.client import Object
from understudy.controller import objects
from understudy.controller.desired import Problem
from understudy.trees.forms import load_health
from understudy.trees.problems import TreeError
from understudy.trees.procedures import load_check, load_procedure

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


def problem(policy: Object) -> Problem | None:
    """Why a policy can't be followed, or None. Missing pools don't count: the next strategy is used then."""
    try:
        parsed = spec(policy)
    except ValidationError as error:
        return Problem("SpecInvalid", invalid(error))
    grace = seconds(parsed.monitoring.startup_grace)
    if found := _tree_problem(parsed.monitoring.form, json.dumps(parsed.monitoring.tree), grace):
        return Problem("TreeInvalid", found)
    recoveries = ((f"spec.strategies[{i}].recovery.yaml", s.recovery) for i, s in enumerate(parsed.strategies))
    if found := procedures_problem(*recoveries):
        return Problem("TreeInvalid", found)
    return None


def pool_problem(pool: Object) -> Problem | None:
    """Why a pool can't be followed, as far as its own spec says; None if it can."""
    try:
        parsed = pool_spec(pool)
    except ValidationError as error:
        return Problem("SpecInvalid", invalid(error))
    if found := procedures_problem(
        ("spec.initialization.yaml", parsed.initialization), ("spec.readinessCheck.yaml", parsed.readiness_check)
    ):
        return Problem("TreeInvalid", found)
    return None


def procedures_problem(*found: tuple[str, Procedure | Check | None]) -> str | None:
    """What is wrong with procedures and checks, each with the path of its tree; None where nothing is."""
    problems = [
        problem
        for path, tree in found
        if tree is not None
        and (problem := _procedure_problem(json.dumps(tree.yaml), path, isinstance(tree, Check))) is not None
    ]
    return "; ".join(problems) or None


@functools.lru_cache(maxsize=512)
def _procedure_problem(tree: str, path: str, is_check: bool) -> str | None:
    try:
        (load_check if is_check else load_procedure)(json.loads(tree), path=path)
    except TreeError as error:
        return error.in_short()
    return None


@functools.lru_cache(maxsize=512)
def _tree_problem(form: str, tree: str, grace: float) -> str | None:
    try:
        load_health(form, json.loads(tree), grace=grace)
    except TreeError as error:
        return error.in_short()
    return None


def named_pools(policy: Object) -> list[str]:
    """The pools that the policy's strategies name, in order."""
    strategies = (policy.get("spec") or {}).get("strategies") or []
    return [s["poolRef"]["name"] for s in strategies if (s.get("poolRef") or {}).get("name")]


def readiness(pool: Object) -> str:
    """The pool's readiness."""
    found: str = (pool.get("spec") or {}).get("readiness", "")
    return found


def pool_spec(pool: Object) -> FallbackPoolSpec:
    """A pool's spec. Raises ValidationError where a stored one doesn't fit the present kind."""
    return FallbackPoolSpec.model_validate(pool.get("spec") or {})


def in_short(policy: Object, pools: Mapping[str, Object]) -> str:
    """The strategies in order, such as ``Executing, Restart``."""
    told = []
    for strategy in (policy.get("spec") or {}).get("strategies") or []:
        if strategy.get("type") == "Restart":
            told.append("Restart")
            continue
        pool = (strategy.get("poolRef") or {}).get("name", "")
        told.append(readiness(pools[pool]) if pool in pools else f"Fallback/{pool}")
    return ", ".join(told)


def conditions(policy: Object, pools: Mapping[str, Object]) -> list[Condition]:
    """The policy's Accepted condition."""
    generation = objects.generation(policy)
    found = problem(policy)
    if found is None:
        for index, name in enumerate(named_pools(policy)):
            if name not in pools:
                found = Problem(
                    "PoolNotFound",
                    f'spec.strategies: FallbackPool "{name}" is not in namespace {policy["metadata"]["namespace"]} '
                    f"({objects.hint(name, pools)}). Create it, or correct the name that the {index + 1}. poolRef "
                    f"has; until then that strategy is passed over",
                )
                break
    if found is not None:
        return [condition("Accepted", False, found.reason, found.message, generation=generation)]
    return [condition("Accepted", True, "Accepted", "It can be followed.", generation=generation)]


def status(policy: Object, *, pools: Mapping[str, Object], users: Collection[str]) -> Object:
    """The policy's status, but for the times of its conditions."""
    return {
        "observedGeneration": objects.generation(policy),
        "workloads": len(users),
        "strategies": in_short(policy, pools),
        "conditions": [c.to_wire() for c in conditions(policy, pools)],
    }
