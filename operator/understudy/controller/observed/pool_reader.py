"""Reads FallbackPools: their specs, whether they are valid, and which workloads they serve."""

from __future__ import annotations

from pydantic import ValidationError

from understudy.api.kinds import fallback_pool
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.controller.observed import kube_objects, policy_reader
from understudy.controller.plan import Problem
from understudy.kube import selectors
from understudy.kube.client import Object

INITIALIZATION = "spec.initialization"
"""Path of the procedure that initializes a pool's standbys."""


def problem(pool: Object) -> Problem | None:
    """Return why a pool's own spec is invalid, or None. Raises Unjudged."""
    try:
        parsed = spec(pool)
    except ValidationError as error:
        return Problem("SpecInvalid", policy_reader.invalid(error))
    return policy_reader.procedures_problem(
        (INITIALIZATION, parsed.initialization), ("spec.readinessCheck", parsed.readiness_check)
    )


def readiness(pool: Object) -> str:
    """Return the pool's readiness."""
    found: str = (pool.get("spec") or {}).get("readiness", "")
    return found


def is_shared(pool: Object) -> bool:
    """Return whether the pool's pods belong to no workload until one claims them."""
    return fallback_pool.is_shared(readiness(pool))


def has_standbys(pool: Object) -> bool:
    """Return whether every workload has standbys of its own from this pool."""
    return fallback_pool.has_standbys(readiness(pool))


def spec(pool: Object) -> FallbackPoolSpec:
    """Return a pool's spec. Raises ValidationError if a stored spec does not match the current API."""
    return FallbackPoolSpec.model_validate(pool.get("spec") or {})


def serves(pool: Object, workload: Object) -> bool:
    """Whether a pool's selector matches a workload."""
    selector = (pool.get("spec") or {}).get("workloadSelector") or {}
    return selectors.matches(selector, kube_objects.labels(workload))
