"""Existing controllers that a workload refers to: whether they can be protected, and the labels of their pods."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.api import names
from understudy.api.kinds.robot_workload import WorkloadReference
from understudy.controller.observed import kube_objects, ownership
from understudy.controller.plan import Patch, Problem
from understudy.kube import selectors
from understudy.kube.apply import controller_of
from understudy.kube.client import PODS, Object


@dataclass(frozen=True)
class ReferencedObjects:
    """The object of ``workloadRef``."""

    controller: Object | None = None
    """The Deployment or StatefulSet; None if it does not exist."""
    pods: Sequence[Object] = ()
    """Its pods."""


def problem(
    reference: WorkloadReference, referred: ReferencedObjects, rivals: Sequence[str], namespace: str
) -> Problem | None:
    """Return why a referred controller cannot be protected, or None."""
    target = f"{reference.kind} {reference.name}"
    controller = referred.controller
    if controller is None:
        return Problem(
            "ReferenceNotFound",
            f'spec.workloadRef: no {reference.kind} "{reference.name}" in namespace {namespace}. Create it, or correct '
            f"kind and name",
        )
    replicas = (controller.get("spec") or {}).get("replicas", 1)
    if replicas != 1:
        return Problem(
            "ReplicasNotOne",
            f"{target}: spec.replicas is {replicas}; exactly one pod controls a robot, so it must be 1. Standbys come from "
            f"a FallbackPool",
        )
    if rivals:
        return Problem(
            "ReferenceTaken",
            f"{target} is already protected by RobotWorkload {rivals[0]}. Delete one of the two RobotWorkloads",
        )
    selector = (controller.get("spec") or {}).get("selector") or {}
    if not selectors.requirements(selector):
        return Problem(
            "ReferenceInvalid", f"{target}: spec.selector is empty, so its pods cannot be distinguished from others"
        )
    return None


def label_keys(referred: ReferencedObjects) -> frozenset[str]:
    """Return the label keys with which the controller, or an object that it creates, would adopt a pod."""
    selector = ((referred.controller or {}).get("spec") or {}).get("selector") or {}
    return frozenset(requirement["key"] for requirement in selectors.requirements(selector))


def controlled(controller: Object, replica_sets: Sequence[Object], pods: Sequence[Object]) -> list[Object]:
    """Return the pods that a Deployment (through its ReplicaSets) or a StatefulSet controls, of those it selects."""
    controllers = {kube_objects.uid(controller)}
    controllers |= {kube_objects.uid(item) for item in replica_sets if _controller_uid(item) in controllers}
    return [pod for pod in pods if _controller_uid(pod) in controllers]


def _controller_uid(item: Object) -> str:
    owners = item["metadata"].get("ownerReferences") or []
    return next((owner["uid"] for owner in owners if owner.get("controller")), "")


def labelling(workload: str, pods: Sequence[Object], referred: ReferencedObjects | None) -> Iterator[Patch]:
    """Yield patches that label every instance, so that the gate can select it, and remove the labels from other pods."""
    for pod in pods:
        if kube_objects.labels(pod).get(names.SOURCE) == "workload" and not kube_objects.deleted(pod):
            yield from label(pod, {names.INSTANCE: kube_objects.name(pod)})
    if referred is None or referred.controller is None:
        return
    for pod in referred.pods:
        if not kube_objects.deleted(pod):
            yield from label(pod, {names.WORKLOAD: workload, names.INSTANCE: kube_objects.name(pod)})
    keep = {kube_objects.uid(pod) for pod in referred.pods}
    # A controller releases a pod if somebody changes a label of its selector. The pod still runs, so it stays gated.
    keep |= {kube_objects.uid(pod) for pod in pods if controller_of(pod) is None}
    yield from unlabelling(workload, pods, keep=keep)


def label(pod: Object, wanted: Mapping[str, Any]) -> Iterator[Patch]:
    """Yield the patch that gives a pod these labels; nothing if it has them."""
    if any(kube_objects.labels(pod).get(key) != value for key, value in wanted.items()):
        yield Patch(PODS, pod, {"metadata": {"labels": dict(wanted)}})


def unlabelling(workload: str, pods: Sequence[Object], *, keep: Collection[str]) -> Iterator[Patch]:
    """Yield patches that remove Understudy's labels from pods that it labelled but did not create.

    Pods that it created keep them: their own ReplicaSet selects them by these labels, and would release them. The owner
    shows that Understudy created a pod, because anyone may have removed the other labels.
    """
    for pod in pods:
        found = kube_objects.labels(pod)
        ours = names.SOURCE in found or names.POOL in found or ownership.is_understudys(pod)
        if found.get(names.WORKLOAD) == workload and not ours and kube_objects.uid(pod) not in keep:
            yield Patch(PODS, pod, {"metadata": {"labels": {names.WORKLOAD: None, names.INSTANCE: None}}})
