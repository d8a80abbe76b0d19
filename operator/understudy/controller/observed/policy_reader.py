"""Reads FailurePolicies: their specs, whether they are valid, and which pools and health tree they name."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping

from pydantic import ValidationError

from understudy.api.base import seconds
from understudy.api.kinds.failure_policy import FailurePolicySpec, StormGuard
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.tree_spec import Written
from understudy.controller.observed import health_tree_sources, situation_strategies
from understudy.controller.plan import Problem
from understudy.kube.client import Object
from understudy.trees.languages.notations import load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.problems import TreeError

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


def procedures_problem(*found: tuple[str, Procedure | Check | None]) -> str | None:
    """Return the problems of procedures and checks, which are given with their paths; None if there are none."""
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
    """Yield the trees of ``spec.situations`` and ``spec.degraded`` with their paths."""
    for index, situation in enumerate(parsed.situations):
        if situation.when.languages:
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
