"""Nodes whose pods are about to go: those that are emptied, and those that were lost."""

from __future__ import annotations

from collections.abc import Collection

from understudy.cluster.client import Object
from understudy.controller import objects

_TAINTS = frozenset(
    {
        # How those that remove nodes mark the ones that they are about to empty. ``kubectl drain`` cordons.
        "ToBeDeletedByClusterAutoscaler",
        "karpenter.sh/disrupted",
        # Of a lost node nothing is known any more, and its pods are evicted a while later.
        "node.kubernetes.io/not-ready",
        "node.kubernetes.io/unreachable",
    }
)


def is_leaving(node: Object) -> bool:
    """Whether a node's pods are better replaced elsewhere: it takes no new ones, or was lost."""
    spec = node.get("spec") or {}
    return bool(spec.get("unschedulable")) or any(taint.get("key") in _TAINTS for taint in spec.get("taints") or [])


def leaving(found: Collection[Object]) -> frozenset[str]:
    """The names of those among all nodes; none where no node is left that others could be put on."""
    names = frozenset(objects.name(node) for node in found if is_leaving(node))
    return names if len(names) < len(found) else frozenset()


def of(pod: Object) -> str:
    """The node that a pod is on; empty while it is on none."""
    found: str | None = (pod.get("spec") or {}).get("nodeName")
    return found or ""


def on(pod: Object, names: Collection[str]) -> bool:
    """Whether a pod is on one of these nodes."""
    return of(pod) in names
