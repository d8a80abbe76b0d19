"""The gate of a workload among the given files, and the pods that the files describe."""

from __future__ import annotations

from typing import Any

from understudy.cli.manifests.manifest_reader import Manifest, at
from understudy.kube.gates import registry
from understudy.kube.gates.base import GateKind

_TEMPLATES = ("Deployment", "StatefulSet", "DaemonSet", "ReplicaSet")


def gate(workload: Manifest) -> GateKind:
    """Return the kind of a workload's gate."""
    found = at(workload.data, "spec", "gate", "kind")
    return registry.KINDS.get(found, registry.DEFAULT) if isinstance(found, str) else registry.DEFAULT


def pod(manifest: Manifest) -> tuple[str, Any] | None:
    """Return the path and the spec of the pod that a manifest describes; None if it describes none."""
    if manifest.kind == "Pod":
        return "spec", at(manifest.data, "spec")
    if manifest.kind in _TEMPLATES:
        return "spec.template.spec", at(manifest.data, "spec", "template", "spec")
    return None


def pod_labels(manifest: Manifest) -> dict[str, str]:
    """Return the labels of that pod."""
    above = () if manifest.kind == "Pod" else ("spec", "template")
    found = at(manifest.data, *above, "metadata", "labels")
    return {key: value for key, value in found.items() if isinstance(value, str)} if isinstance(found, dict) else {}
