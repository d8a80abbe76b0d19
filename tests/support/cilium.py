"""Cilium's identities, and the policies of a workload whose entries they need."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.kube.client import Object
from understudy.kube.gates.base import Reach
from understudy.kube.gates.kinds.network_policy import GATE

NAME = "robot-17-navigation"
EACH = 63
"""Entries for each peer of the instance in control: 26 of its egress, 29 of its ingress, 8 of the gate."""


def policies(reach: Reach | None = None, name: str = NAME) -> list[Object]:
    """The policies of a workload, with the gate closed."""
    reach = reach or Reach()
    return [*(one for _, one in GATE.companions(name, reach)), GATE.closed(name, reach, epoch=0)]


def identity(
    number: int, *, namespace: str = "fleet", namespace_labels: Mapping[str, str] | None = None, **labels: str
) -> Object:
    """The identity of pods with these labels."""
    of_namespace = {
        f"k8s:io.cilium.k8s.namespace.labels.{key}": value for key, value in (namespace_labels or {}).items()
    }
    own = {"k8s:app": f"robot-{number}"} | {f"k8s:{key}": value for key, value in labels.items()}
    place = {"k8s:io.kubernetes.pod.namespace": namespace, "k8s:io.cilium.k8s.policy.cluster": "c"}
    return {"metadata": {"name": str(number)}, "security-labels": place | of_namespace | own}
