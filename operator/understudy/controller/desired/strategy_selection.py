"""Selects the order of a workload's strategies, if its policy leaves the order open.

Takes objects of the API. This is the only place where requirements become strategies. The operator,
``understudy check`` and ``understudy recommend`` all use it, and the monitor receives the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from understudy.advice.strategy_figures import Figure, Figures, Way, measured_times
from understudy.advice.strategy_order import Candidate, Order, order_strategies
from understudy.api.base import LocalReference
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.kinds.requirements_spec import Requirements
from understudy.api.kinds.robot_workload import Recovery
from understudy.controller.observed import situation_strategies
from understudy.controller.pods import pool_size
from understudy.kube.client import Object


def is_auto(policy: Object) -> bool:
    """Whether a policy leaves its strategies to be selected."""
    return _auto(policy) is not None


def varies(policy: Object) -> bool:
    """Whether the strategies in force differ between workloads, because of requirements or situations."""
    return is_auto(policy) or situation_strategies.has_some(policy)


def order(
    policy: Object,
    workload: Object,
    pools: Mapping[str, Object],
    *,
    requirements: Requirements | None = None,
    cpu: Mapping[Way, Figure] | None = None,
    sharing: Mapping[str, int] | None = None,
) -> Order | None:
    """Return the order for a workload, its policy and the pools that serve it; None if the requirements are invalid.

    ``requirements`` replaces those of the policy. ``cpu`` is the measured use of standbys. ``sharing`` is how many
    workloads each shared pool serves.
    """
    spec = _mapping(policy, "spec")
    if requirements is None:
        try:
            requirements = Requirements.model_validate(spec.get("requirements") or {})
        except ValidationError:
            return None
    known = Figures(measured_seconds=measured_times(_recoveries(workload)), measured_cpu=cpu or {})
    return order_strategies(
        requirements,
        (
            found
            for name, pool in pools.items()
            if (found := _candidate(name, pool, (sharing or {}).get(name, 1))) is not None
        ),
        known,
        safe_commands=bool(spec.get("safety")),
    )


def strategies(policy: Object, order: Order) -> list[Strategy]:
    """Return the strategies that replace a policy's Auto, each with the times that Auto gives."""
    auto = _auto(policy)
    common_fields = {} if auto is None else {key: auto[key] for key in ("verifyWithin",) if key in auto}
    found = []
    for one in order.chosen:
        if one.candidate.way == "Restart":
            found.append(Strategy.model_validate({"type": "Restart", **common_fields}))
        else:
            pool = LocalReference(name=one.candidate.pool)
            found.append(Strategy.model_validate({"type": "Fallback", "poolRef": pool, **common_fields}))
    return found


def _auto(policy: Object) -> Mapping[str, Any] | None:
    listed = _mapping(policy, "spec").get("strategies")
    for one in listed if isinstance(listed, list) else ():
        if isinstance(one, Mapping) and one.get("type") == "Auto":
            return one
    return None


def _candidate(name: str, pool: Object, sharing: int) -> Candidate | None:
    """Return what a pool offers; None if it has no pods, or is invalid."""
    try:
        spec = FallbackPoolSpec.model_validate(pool.get("spec") or {})
    except ValidationError:
        return None
    standbys = pool_size.size(pool) / sharing if spec.level.shared else float(spec.per_workload or 0)
    return Candidate(spec.readiness, name, standbys) if standbys else None


def _recoveries(workload: Object) -> Iterator[Recovery]:
    listed = _mapping(workload, "status").get("recoveries")
    for one in listed if isinstance(listed, list) else ():
        try:
            yield Recovery.model_validate(one)
        except ValidationError:
            continue  # written by another version


def _mapping(item: Object, key: str) -> Mapping[str, Any]:
    found = item.get(key)
    return found if isinstance(found, Mapping) else {}
