"""A gate of its own for a test, in front of an API server in memory."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.unit.kube.memory import MemoryClient
from understudy.api import names
from understudy.clock import CLOCK
from understudy.failover.interfaces import Instance
from understudy.kube.client import NETWORK_POLICIES, Object
from understudy.kube.gates.base import Proof
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.notices import Notices
from understudy.monitor.observe.objects.cluster_view import ClusterView


class Packets(Proof):
    """Packets that got through, as a test gives them: the last one of each pod by its UID."""

    def __init__(self, last: Mapping[str, float]) -> None:
        self._last = last

    def last(self, uid: str) -> float | None:
        return self._last.get(uid)

    def heard_since(self, time: float) -> Sequence[str]:
        return [uid for uid, last in self._last.items() if last >= time]

    async def wait(self, uid: str, after: float) -> float:
        while (last := self._last.get(uid, 0.0)) < CLOCK.to_system(after):
            await asyncio.sleep(0.005)
        return CLOCK.of_system(last)


class PacketsOfReached(Packets):
    """No packet got through, and only those of some pods would count, by their UIDs."""

    def __init__(self, *reached: str) -> None:
        super().__init__({})
        self.reached = set(reached)

    def recognizes(self, uid: str) -> bool:
        return uid in self.reached


async def gate(client: MemoryClient, found: ClusterView, tmp_path: Path, active: Instance | None = None) -> GateControl:
    """One at epoch 4, which says that it is open for a pod where one is given."""
    annotations = {names.EPOCH: "4"}
    if active is not None:
        annotations |= {names.ACTIVE: active.name, names.ACTIVE_UID: active.uid}
    body: Object = {
        "metadata": {"name": names.gate(found.workload), "labels": {"app": "w"}, "annotations": annotations},
        "spec": {"podSelector": {"matchLabels": {names.INSTANCE: active.name if active is not None else "w-1"}}},
    }
    found.gates.put(await client.create(NETWORK_POLICIES, "fleet", body))

    crash_points, notices = CrashPoints(tmp_path), Notices()
    pods = PodControl(client, found, crash_points, notices)
    return GateControl(client, found, pods, Packets({}), crash_points, notices)
