"""What a monitor reads of its workload and its pool, for tests."""

from __future__ import annotations

from tests.unit.kube.memory import MemoryClient
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups


def view(client: MemoryClient, workload: str) -> ClusterView:
    return ClusterView(client, "fleet", workload, Wakeups())
