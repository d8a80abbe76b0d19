"""The order of a workload's strategies where its policy leaves it to be chosen, from objects as they are.

The one place in which requirements become strategies: operator, ``understudy check`` and ``understudy recommend`` all ask here, and
the monitor is told what came of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from understudy.advice.strategy_figures import Figure, Figures, Way, seen
from understudy.advice.strategy_order import Candidate, Order, ordered
from understudy.api.base import LocalReference
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.kinds.requirements_spec import Requirements
from understudy.api.kinds.robot_workload import Recovery
from understudy.controller.observed import situation_strategies
from understudy.controller.pods import pool_size
from understudy.kube.client import Object


def is_auto(policy: Object) -> bool:
    """Whether a policy leaves its strategies to be chosen."""
    return _auto(policy) is not None


def varies(policy: Object) -> bool:
    """Whether which strategies are in force is decided for each workload: by what is required, or by its situation."""
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
    """The order for a workload by a policy, with the pools that serve it. None where the policy's requirements aren't understood.

    ``requirements`` are taken instead of the policy's; ``cpu`` is what waiting instances were measured to use, and ``sharing`` how many
    workloads each shared pool serves.
    """
    spec = _mapping(policy, "spec")
    if requirements is None:
        try:
            requirements = Requirements.model_validate(spec.get("requirements") or {})
        except ValidationError:
            return None
    known = Figures(measured_seconds=seen(_recoveries(workload)), measured_cpu=cpu or {})
    return ordered(
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
    """The strategies that stand for a policy's Auto, each with the time that this one gives."""
    auto = _auto(policy)
    given = {} if auto is None else {key: auto[key] for key in ("verifyWithin",) if key in auto}
    found = []
    for one in order.chosen:
        if one.candidate.way == "Restart":
            found.append(Strategy.model_validate({"type": "Restart", **given}))
        else:
            pool = LocalReference(name=one.candidate.pool)
            found.append(Strategy.model_validate({"type": "Fallback", "poolRef": pool, **given}))
    return found


def _auto(policy: Object) -> Mapping[str, Any] | None:
    listed = _mapping(policy, "spec").get("strategies")
    for one in listed if isinstance(listed, list) else ():
        if isinstance(one, Mapping) and one.get("type") == "Auto":
            return one
    return None


def _candidate(name: str, pool: Object, sharing: int) -> Candidate | None:
    """What a pool offers; None where it is empty, or doesn't fit the kind."""
    try:
        spec = FallbackPoolSpec.model_validate(pool.get("spec") or {})
    except ValidationError:
        return None
    shared = spec.readiness == "Uninitialized"
    standbys = pool_size.size(pool) / sharing if shared else float(spec.per_workload or 0)
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
