"""Gives the active pod more CPU or memory in place while its workload is degraded (KEP-1287).

Resources are only raised, and stay raised for the life of the pod: if they were taken back as soon as the workload
recovers, they would be missing again. The next pod starts with the resources of its template.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from understudy.api.conditions import Condition, condition
from understudy.api.kinds.degraded_spec import Resize
from understudy.api.quantities import amount
from understudy.controller.desired.workload_plan import WorkloadPlan
from understudy.controller.observed import degraded_measures, kube_objects
from understudy.controller.observed.observation import Observed
from understudy.controller.plan import Patch, Problem
from understudy.controller.reconcile.executor import RESIZE
from understudy.kube.client import PODS, STRATEGIC, Object

CONDITION = "Resized"

_ADVICE = {
    "Deferred": "The kubelet retries when the node has room",
    "Infeasible": "Request less in the policy, or use larger nodes",
}
"""Advice to the user, by the kubelet's reason for a pending resize."""


@dataclass(frozen=True)
class ResizeOutcome:
    """The progress of one resize, and the write that it needs."""

    reason: str
    """The reason of the condition: Resized if the resize is complete."""
    message: str
    write: Patch | None = None


def outcomes(observed: Observed, workload_plan: WorkloadPlan) -> list[ResizeOutcome]:
    """Return the progress of the policy's resizes on the active pod; empty while the workload is not degraded."""
    pod, spec = observed.resized, workload_plan.spec
    if pod is None or spec is None or workload_plan.policy_problem is not None:
        return []
    asked = degraded_measures.actions(observed.policies.get(spec.failure_policy_ref.name))
    return [_outcome(pod, index, action.resize) for index, action in enumerate(asked) if action.resize is not None]


def refused(outcome: ResizeOutcome, problem: Problem) -> ResizeOutcome:
    """Return the outcome for a write that the API server refuses."""
    words = f"{outcome.message}, which the API server rejects: {problem.message}"
    return replace(outcome, reason="Refused", message=words, write=None)


def judged(found: Sequence[ResizeOutcome]) -> Condition | None:
    """Return the condition Resized of the workload, or None if no resize is requested."""
    if not found:
        return None
    shown = next((one for one in found if one.reason != "Resized"), None)
    if shown is not None:
        return condition(CONDITION, False, shown.reason, f"{shown.message}.")
    words = "; ".join(one.message for one in found)
    return condition(CONDITION, True, "Resized", f"{words}.")


def _outcome(pod: Object, index: int, resize: Resize) -> ResizeOutcome:
    containers = pod["spec"]["containers"]
    name = resize.container or containers[0]["name"]
    container = next((one for one in containers if one["name"] == name), None)
    if container is None:
        field = f"spec.degraded.actions[{index}].resize.container"
        known = kube_objects.hint(name, (one["name"] for one in containers))
        words = f'FailurePolicy: {field}: pod {kube_objects.name(pod)} has no container "{name}" ({known})'
        return ResizeOutcome("ContainerNotFound", words)
    subject = f"container {name} of pod {kube_objects.name(pod)}"
    amounts = ", ".join(f"{resource} {resources}" for resource, resources in resize.amounts.items())
    more = raised(container.get("resources") or {}, resize.amounts)
    if not more:
        return _progress(pod, name, resize, f"{subject} has {amounts}", f"{subject} is to have {amounts}")
    restarting = _restarting(container) & {resource for resources in more.values() for resource in resources}
    if restarting:
        words = (
            f"{subject} is not resized to {amounts}, because that would restart it: its resizePolicy for "
            f"{', '.join(sorted(restarting))} is RestartContainer. Make it NotRequired in the template"
        )
        return ResizeOutcome("WouldRestart", words)
    metadata = {"uid": kube_objects.uid(pod)}
    body = {"metadata": metadata, "spec": {"containers": [{"name": name, "resources": more}]}}
    return ResizeOutcome("InProgress", f"{subject} is given {amounts}", Patch(PODS, pod, body, RESIZE, STRATEGIC))


def raised(present: Mapping[str, Mapping[str, str]], amounts: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return the requests and limits that must change for a container to have these amounts; empty if none.

    A missing limit is not added, because a limit would restrict the container.
    """
    requests, limits = present.get("requests") or {}, present.get("limits") or {}
    more = {
        "requests": {
            r: resources for r, resources in amounts.items() if r not in requests or _less(requests[r], resources)
        },
        "limits": {r: resources for r, resources in amounts.items() if r in limits and _less(limits[r], resources)},
    }
    return {kind: resources for kind, resources in more.items() if resources}


def _less(present: str, wanted: str) -> bool:
    return amount(str(present)) < amount(wanted)


def _restarting(container: Object) -> set[str]:
    return {
        one["resourceName"]
        for one in container.get("resizePolicy") or []
        if one.get("restartPolicy") == "RestartContainer"
    }


def _progress(pod: Object, name: str, resize: Resize, done: str, message: str) -> ResizeOutcome:
    """Return the outcome of a resize as the kubelet reports it in the pod's status."""
    status = pod.get("status") or {}
    conditions = {c["type"]: c for c in status.get("conditions") or [] if c["status"] == "True"}
    if (pending := conditions.get("PodResizePending")) is not None:
        reason = pending.get("reason") or "Deferred"
        advice = f". {_ADVICE[reason]}" if reason in _ADVICE else ""
        return ResizeOutcome(
            reason, f"{message}, but not now: {pending.get('message', '').rstrip('.') or reason}{advice}"
        )
    if (doing := conditions.get("PodResizeInProgress")) is not None:
        failed = f": {doing['message'].rstrip('.')}" if doing.get("message") else ""
        return ResizeOutcome("ResizeError" if doing.get("reason") == "Error" else "InProgress", f"{message}{failed}")
    statuses = {one["name"]: one for one in status.get("containerStatuses") or []}
    in_force = statuses.get(name, {}).get("resources")
    if in_force is not None and raised(in_force, resize.amounts):
        return ResizeOutcome("InProgress", message)
    return ResizeOutcome("Resized", done)
