"""Nodes whose pods are about to go: those that are emptied, and those that were lost."""

from __future__ import annotations

from collections.abc import Collection

from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

_EMPTIED = frozenset({"ToBeDeletedByClusterAutoscaler", "karpenter.sh/disrupted"})
"""Taints by which those that remove nodes mark the ones that they are about to empty. ``kubectl drain`` cordons."""

_LOST = frozenset({"node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable"})
"""Taints of a node of which nothing is known any more; its pods are evicted a while later."""


def is_cordoned(node: Object) -> bool:
    """Whether a node is to be emptied, or takes no new pods at least: it may be emptied the moment after."""
    return bool((node.get("spec") or {}).get("unschedulable")) or _tainted(node, _EMPTIED)


def is_leaving(node: Object) -> bool:
    """Whether a node's pods are better replaced elsewhere: it takes no new ones, or was lost."""
    return is_cordoned(node) or _tainted(node, _LOST)


def leaving(found: Collection[Object]) -> frozenset[str]:
    """The names of those among all nodes; none where no node is left that others could be put on."""
    names = frozenset(kube_objects.name(node) for node in found if is_leaving(node))
    return names if len(names) < len(found) else frozenset()


def _tainted(node: Object, taints: Collection[str]) -> bool:
    return any(taint.get("key") in taints for taint in (node.get("spec") or {}).get("taints") or [])


def of(pod: Object) -> str:
    """The node that a pod is on; empty while it is on none."""
    found: str | None = (pod.get("spec") or {}).get("nodeName")
    return found or ""


def on(pod: Object, names: Collection[str]) -> bool:
    """Whether a pod is on one of these nodes."""
    return of(pod) in names
