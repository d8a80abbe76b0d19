"""Reads FailurePolicies: their specs, whether they are valid, and which pools and health tree they name."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from pydantic import ValidationError

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec, Monitoring, StormGuard
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.tree_spec import Written
from understudy.controller.observed import health_tree_sources, situation_strategies, tree_verdicts
from understudy.controller.plan import Problem
from understudy.kube.client import Object
from understudy.trees.languages.tree_check import Purpose, TreeText

_MOST_PROBLEMS = 10


def spec(policy: Object) -> FailurePolicySpec:
    """Return the policy's spec. Raises ValidationError if a stored spec does not match the current API."""
    return FailurePolicySpec.model_validate(policy.get("spec") or {})


def invalid(error: ValidationError) -> str:
    """Return the validation errors of a spec, field by field."""
    return "; ".join(
        f"spec.{'.'.join(str(part) for part in found['loc'])}: {found['msg']}"
        for found in error.errors()[:_MOST_PROBLEMS]
    )


def problem(policy: Object, config_maps: Mapping[str, Object]) -> Problem | None:
    """Return why a policy is invalid, or None. Missing pools do not count, because the next strategy is then used.

    ``config_maps`` are those of its namespace. Raises Unjudged.
    """
    try:
        parsed = spec(policy)
    except ValidationError as error:
        return Problem("SpecInvalid", invalid(error))
    tree = health_tree_sources.written(parsed.monitoring, config_maps, policy["metadata"]["namespace"])
    if isinstance(tree, Problem):
        return tree
    grace = seconds(parsed.monitoring.startup_grace)
    first = [tree or _health_tree(parsed.monitoring, "spec.monitoring", grace)]
    first += [_health_tree(inline, f"spec.{path}", grace) for path, inline in parsed.inline_trees]
    return tree_verdicts.problem(first, _procedures((f"spec.{path}", one) for path, one in parsed.recoveries))


def procedures_problem(*found: tuple[str, Procedure | Check | None]) -> Problem | None:
    """Return the problems of procedures and checks, which are given with their paths; None if there are none."""
    return tree_verdicts.problem((), _procedures(found))


def procedure(tree: Procedure | Check, path: str) -> TreeText:
    """Return a procedure or check at a path, to be checked."""
    purpose: Purpose = "check" if isinstance(tree, Check) else "procedure"
    return TreeText(purpose, tree.form, json.dumps(tree.tree), f"{path}.{tree.form}")


def _procedures(found: Iterable[tuple[str, Procedure | Check | None]]) -> list[TreeText]:
    return [procedure(tree, path) for path, tree in found if tree is not None]


def _health_tree(tree: Written | Monitoring, path: str, grace: float) -> TreeText:
    return TreeText("health", tree.form, json.dumps(tree.tree), f"{path}.{tree.form}", grace)


def named_pools(policy: Object) -> list[str]:
    """Return the pools that the policy's strategies name, in order, followed by those of its situations."""
    strategies = (policy.get("spec") or {}).get("strategies") or []
    always = [s["poolRef"]["name"] for s in strategies if (s.get("poolRef") or {}).get("name")]
    return [*always, *situation_strategies.named_pools(policy)]


def tree_in_force(policy: Object, config_maps: Mapping[str, Object]) -> Object | None:
    """Return the health tree in use if it comes from a ConfigMap, or None.

    If the ConfigMap has no valid tree, it is the last valid one.
    """
    try:
        found = health_tree_sources.find(spec(policy).monitoring, config_maps, policy["metadata"]["namespace"])
    except ValidationError:
        found = Problem("SpecInvalid", "reported elsewhere")
    if isinstance(found, Problem):
        last: Object | None = (policy.get("status") or {}).get("tree")
        return last
    return found.to_wire() if found is not None else None


def storm_guard(policy: Object) -> StormGuard | None:
    """Return the policy's storm guard; None if it has none, or an invalid one."""
    guard = ((policy.get("spec") or {}).get("limits") or {}).get("stormGuard")
    if not guard:
        return None  # most policies have none, so there is nothing to parse
    try:
        return StormGuard.model_validate(guard)
    except ValidationError:
        return None
