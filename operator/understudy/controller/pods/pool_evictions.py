"""Delays evictions of a shared pool's waiting pods, such as by ``kubectl drain``, until there are pods on other nodes.

A PodDisruptionBudget makes the API server refuse the evictions. Drain tools retry until the operator has replaced the
pods.
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
"""Maximum delay of evictions, in seconds. The replacements may never start, for example if a quota is exhausted."""


def budget(pool: str, least: int) -> Object:
    """Return the budget that keeps at least ``least`` waiting pods. A pod that is not ready may always be evicted."""
    return disruption_budget(
        names.held(pool), least, {names.POOL: pool, names.HELD: "true", names.CLAIMED_BY: names.UNCLAIMED}
    )


def disruption_budget(name: str, least: int, chosen: Mapping[str, str]) -> Object:
    """Return a budget that keeps at least ``least`` pods with these labels.

    Pods that are not ready may always be evicted.
    """
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
    """Whether a budget belongs to an object of Understudy."""
    owner = controller_of(found)
    return owner is not None and owner.get("apiVersion") == API_VERSION


def decided_elsewhere(budgets: Sequence[Object], labels: Mapping[str, str]) -> bool:
    """Whether another owner's budget selects the pods.

    With two budgets, Kubernetes refuses every eviction permanently.
    """
    return any(selects(found, labels) for found in budgets)


def selects(found: Object, labels: Mapping[str, str]) -> bool:
    """Whether a budget selects pods with these labels."""
    selector = (found.get("spec") or {}).get("selector")
    return selector is not None and selectors.matches(selector, dict(labels))


def patience(coming: Sequence[Object], since: float, now: float) -> float:
    """Return the seconds for which evictions may still wait for the replacements; 0 if one of these cannot start."""
    if any(trouble(pod) is not None for pod in coming):
        return 0.0
    return max(0.0, PATIENCE - (now - since))
