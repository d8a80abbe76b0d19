"""Nodes whose pods are about to go: nodes that are being drained, and lost nodes."""

from __future__ import annotations

from collections.abc import Collection

from understudy.controller.observed import kube_objects
from understudy.kube.client import Object

_EMPTIED = frozenset({"ToBeDeletedByClusterAutoscaler", "karpenter.sh/disrupted"})
"""Taints of autoscalers on nodes that they are about to drain. ``kubectl drain`` cordons a node instead."""

_LOST = frozenset({"node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable"})
"""Taints of a node that no longer reports. Its pods are evicted some time later."""


def is_cordoned(node: Object) -> bool:
    """Whether a node is being drained, or at least accepts no new pods: it may be drained a moment later."""
    return bool((node.get("spec") or {}).get("unschedulable")) or _tainted(node, _EMPTIED)


def is_leaving(node: Object) -> bool:
    """Whether a node's pods should be replaced on other nodes: it accepts no new pods, or was lost."""
    return is_cordoned(node) or _tainted(node, _LOST)


def leaving(found: Collection[Object]) -> frozenset[str]:
    """Return the names of such nodes; empty if there is no other node for their pods."""
    names = frozenset(kube_objects.name(node) for node in found if is_leaving(node))
    return names if len(names) < len(found) else frozenset()


def accepts(node: Object, tolerations: Collection[Object]) -> bool:
    """Whether the scheduler may place a new pod with these tolerations on a node, as far as its state and taints decide."""
    taints = [
        one for one in (node.get("spec") or {}).get("taints") or [] if one.get("effect") in ("NoSchedule", "NoExecute")
    ]
    return not is_leaving(node) and all(any(_tolerates(one, taint) for one in tolerations) for taint in taints)


def another_accepts(found: Collection[Object], place: str, tolerations: Collection[Object]) -> bool:
    """Whether one of these nodes other than ``place`` accepts a new pod with these tolerations."""
    return any(kube_objects.name(node) != place and accepts(node, tolerations) for node in found)


def _tolerates(toleration: Object, taint: Object) -> bool:
    return (
        toleration.get("key") in (None, "", taint.get("key"))
        and toleration.get("effect") in (None, "", taint.get("effect"))
        and (toleration.get("operator") == "Exists" or (toleration.get("value") or "") == (taint.get("value") or ""))
    )


def _tainted(node: Object, taints: Collection[str]) -> bool:
    return any(taint.get("key") in taints for taint in (node.get("spec") or {}).get("taints") or [])


def of(pod: Object) -> str:
    """Return the node of a pod; empty if it has none yet."""
    found: str | None = (pod.get("spec") or {}).get("nodeName")
    return found or ""


def on(pod: Object, names: Collection[str]) -> bool:
    """Whether a pod is on one of these nodes."""
    return of(pod) in names
