"""Replacement standbys: pods of a workload's own controller that wait in place of a standby that is active."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api import names
from understudy.controller.observed import kube_objects, situation_strategies
from understudy.kube.client import Object


def may_replace(workload: Object, policy: Object | None) -> bool:
    """Whether a pod of a workload's own controller waits as a standby while another pod is active.

    The pods of a referred controller do not, because they have no agent. It is also false if the strategies depend on
    the situation: the standby for which the pod waits would change with the situation.
    """
    refers = (workload.get("spec") or {}).get("workloadRef") is not None
    return not refers and (policy is None or not situation_strategies.has_some(policy))


def displaced(gate: Object | None, pods: Sequence[Object]) -> str:
    """Return the pool whose standby is active, from a workload's gate and pods; empty if another pod or none is active."""
    driving = next((pod for pod in pods if kube_objects.is_active(pod, gate)), None)
    if driving is None or names.CLAIM in kube_objects.notes(driving):
        return ""
    return kube_objects.labels(driving).get(names.POOL, "")


def of_pool(pool: str, gate: Object | None, pods: Sequence[Object]) -> list[Object]:
    """Return the living pods of a workload's own controller that wait in place of a pool's active standby."""
    if displaced(gate, pods) != pool:
        return []
    return [pod for pod in pods if is_own(pod)]


def is_own(pod: Object) -> bool:
    """Whether a pod is a living one of a workload's own controller."""
    return kube_objects.labels(pod).get(names.SOURCE) == "workload" and kube_objects.alive(pod)
