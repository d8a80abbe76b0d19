"""The objects that the act stage reads and changes in the cluster, as one value."""

from __future__ import annotations

from dataclasses import dataclass

from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.observe.objects.cluster_view import ClusterView


@dataclass(frozen=True)
class Cluster:
    """The objects of one workload."""

    view: ClusterView
    pods: PodControl
    gate: GateControl
