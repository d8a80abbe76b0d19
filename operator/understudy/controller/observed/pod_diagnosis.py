"""Determines why a pod does not run, and how to correct it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

_ADVICE = {
    "ImagePullBackOff": "Check the image name, the registry's availability and imagePullSecrets",
    "ErrImageNeverPull": "The image is not on the node and imagePullPolicy is Never: load the image or allow pulling",
    "InvalidImageName": "Correct the image's name",
    "CrashLoopBackOff": "Find the cause: kubectl logs --previous -n {namespace} {pod} -c {container}",
    "CreateContainerConfigError": (
        "A referenced object, such as a ConfigMap or Secret, is missing: see kubectl describe pod -n {namespace} {pod}"
    ),
    "CreateContainerError": "See kubectl describe pod -n {namespace} {pod}",
    "RunContainerError": "See kubectl describe pod -n {namespace} {pod}",
    "StartError": "Check that the command exists in the image",
    "Unschedulable": "No node accepts the pod: check its requests, its nodeSelector and the free resources of the nodes",
}
_CRASHES = 2
_SAME = {"ErrImagePull": "ImagePullBackOff", "ImageInspectError": "ImagePullBackOff"}  # they alternate for one cause


@dataclass(frozen=True)
class Diagnosis:
    """A problem that prevents a pod from running."""

    reason: str
    message: str


def trouble(pod: Object) -> Diagnosis | None:
    """Return why a pod cannot start, or None if it runs or has merely not started yet."""
    if not kube_objects.alive(pod):
        return None
    status = pod.get("status") or {}
    for entry in [*(status.get("initContainerStatuses") or []), *(status.get("containerStatuses") or [])]:
        waiting = (entry.get("state") or {}).get("waiting") or {}
        reason = _SAME.get(waiting.get("reason", ""), waiting.get("reason", ""))
        if reason not in _ADVICE and _crashing(pod, entry):
            reason, waiting = "CrashLoopBackOff", {}
        if reason in _ADVICE:
            return _diagnosis(
                pod, reason, entry["name"], f"container {entry['name']} (image {entry.get('image', '')})", waiting
            )
    for condition in status.get("conditions") or []:
        if condition["type"] == "PodScheduled" and condition["status"] == "False":
            reason = condition.get("reason") or ""
            if reason in _ADVICE:
                return _diagnosis(pod, reason, "", "it", condition)
    return None


def first(pods: Sequence[Object]) -> Diagnosis | None:
    """Return the problem of the oldest pod that cannot start, or None."""
    return next((found for pod in sorted(pods, key=kube_objects.sort_key) if (found := trouble(pod))), None)


def _crashing(pod: Object, entry: Object) -> bool:
    """Whether a container is between two crashes.

    It then counts as crashing, so that the report does not change with each crash.
    """
    terminated = (entry.get("lastState") or {}).get("terminated") or {}
    again = entry.get("restartCount", 0) >= _CRASHES and terminated.get("exitCode", 0) != 0
    return again and not kube_objects.ready(pod)


def _diagnosis(pod: Object, reason: str, container: str, what: str, found: Object) -> Diagnosis:
    name, namespace = kube_objects.name(pod), pod["metadata"].get("namespace", "")
    words = _steady(found.get("message", ""), name)
    advice = _ADVICE[reason].format(namespace=namespace, pod=name, container=container)
    detail = f": {words}" if words else ""
    return Diagnosis(reason, f"pod {name}: {what} cannot start, {reason}{detail}. {advice}.")


def _steady(words: str, pod: str) -> str:
    """Return the kubelet's message without the parts that change with each attempt.

    The condition then does not change with each attempt.
    """
    if words.startswith("back-off "):
        return ""
    words = words.removesuffix(".").replace(f'"{pod}"', "the pod")
    return words if len(words) <= 300 else words[:299] + "…"
