"""Evictions of a shared pool's waiting pods, as ``kubectl drain`` asks for: refused until there are others elsewhere.

A PodDisruptionBudget says so to the API server, and whoever drains tries again until the operator has replaced them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.kube import selectors
from understudy.kube.apply import controller_of
from understudy.kube.client import Object

PATIENCE = 120.0
"""Seconds for which evictions wait at most: what is to come in place of the pods may never come, such as where a quota is used up."""


def budget(pool: str, least: int) -> Object:
    """The budget by which so many waiting pods stay. One that isn't ready is nobody's loss."""
    return keeping(names.held(pool), least, {names.POOL: pool, names.HELD: "true"})


def keeping(name: str, least: int, chosen: Mapping[str, str]) -> Object:
    """A budget by which at least so many of the pods with these labels stay; those that aren't ready may always go."""
    return {
        "apiVersion": "policy/v1",
        "kind": "PodDisruptionBudget",
        "metadata": {"name": name},
        "spec": {
            "minAvailable": least,
            "unhealthyPodEvictionPolicy": "AlwaysAllow",
            "selector": {"matchLabels": dict(chosen)},
        },
    }


def is_ours(found: Object) -> bool:
    """Whether a budget was made for an object of ours."""
    owner = controller_of(found)
    return owner is not None and owner.get("apiVersion") == API_VERSION


def decided_elsewhere(budgets: Sequence[Object], labels: Mapping[str, str]) -> bool:
    """Whether a budget of somebody else's selects the pods: with two of them Kubernetes refuses every eviction, for good."""
    return any(selects(found, labels) for found in budgets)


def selects(found: Object, labels: Mapping[str, str]) -> bool:
    """Whether a budget is for pods with these labels."""
    selector = (found.get("spec") or {}).get("selector")
    return selector is not None and selectors.matches(selector, dict(labels))


def patience(coming: Sequence[Object], since: float, now: float) -> float:
    """Seconds for which evictions may still wait for the pods that are to come; 0 where one of them can't."""
    if any(trouble(pod) is not None for pod in coming):
        return 0.0
    return max(0.0, PATIENCE - (now - since))
