"""Pods of a workload's own controller that wait as a standby, in the place of a standby that drives."""

from __future__ import annotations

from collections.abc import Sequence

from understudy.api import names
from understudy.controller.observed import kube_objects, situation_strategies
from understudy.kube.client import Object


def may_stand_in(workload: Object, policy: Object | None) -> bool:
    """Whether a pod that a workload's own controller makes waits as a standby while another one drives.

    Not what a referred controller makes, which has no agent. Nor where what is in force changes with the situation: as whose
    standby it waits would change with it.
    """
    refers = (workload.get("spec") or {}).get("workloadRef") is not None
    return not refers and (policy is None or not situation_strategies.has_some(policy))


def displaced(gate: Object | None, pods: Sequence[Object]) -> str:
    """The pool whose standby drives, by a workload's gate and its pods; empty where another pod does, or none."""
    driving = next((pod for pod in pods if kube_objects.is_active(pod, gate)), None)
    if driving is None or names.CLAIM in kube_objects.notes(driving):
        return ""
    return kube_objects.labels(driving).get(names.POOL, "")


def standing_in(pool: str, gate: Object | None, pods: Sequence[Object]) -> list[Object]:
    """The living pods of a workload's own controller that wait for a pool whose standby drives."""
    if displaced(gate, pods) != pool:
        return []
    return [pod for pod in pods if is_own(pod)]


def is_own(pod: Object) -> bool:
    """Whether a pod is a living one of a workload's own controller."""
    return kube_objects.labels(pod).get(names.SOURCE) == "workload" and kube_objects.alive(pod)
