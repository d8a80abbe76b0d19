"""Claimed pods that nobody brings up, and failed ones, are deleted, and no others."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import aiohttp
import pytest

from understudy.failover.abandoned import ended
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.act.instances.garbage_collection import FAILED_FOR, LEFT_FOR, GarbageCollection

DRIVES = Instance(name="spare-1", uid="uid-1", pool="spare", running=True, claim="uid-w/1")
LEFT = replace(DRIVES, name="spare-2", uid="uid-2", claim="uid-w/2")
STANDBY = Instance(name="w-1", uid="uid-3", pool="hot", running=True)


class Cluster:
    """The fleet, the gate and the reporter in one."""

    instances = (DRIVES, STANDBY)

    def __init__(self, **gate: str) -> None:
        self.state = GateState(epoch=3, **{"active": "spare-1", "active_uid": "uid-1", **gate})  # type: ignore[arg-type]
        self.named = "uid-1"
        self.away = False
        self.deleted: list[str] = []
        self.events: list[str] = []

    def of_workload(self) -> tuple[Instance, ...]:
        return self.instances

    async def lets_through(self, instance: Instance) -> bool:
        if self.away:
            raise aiohttp.ClientConnectionError
        return instance.uid == self.named

    async def retire(self, instance: Instance) -> None:
        self.deleted.append(instance.name)

    def event(self, kind: str, reason: str, message: str) -> None:
        self.events.append(reason)


async def look(
    cluster: Any, *instances: Instance, seconds: float = LEFT_FOR, garbage: GarbageCollection | None = None
) -> None:
    found = garbage or GarbageCollection(cluster, cluster, cluster)
    found.housekeeping(instances, 100.0)
    found.housekeeping(instances, 100.0 + seconds)
    for _ in range(5):
        await asyncio.sleep(0)


async def test_a_claimed_pod_that_stays_inactive_for_long_is_deleted() -> None:
    cluster = Cluster()
    await look(cluster, DRIVES, LEFT, STANDBY)
    assert cluster.deleted == ["spare-2"]
    assert cluster.events == ["LeftoverDeleted"]


async def test_a_recently_claimed_pod_is_not_deleted() -> None:
    cluster = Cluster()
    await look(cluster, DRIVES, LEFT, seconds=LEFT_FOR - 1)
    assert not cluster.deleted


async def test_no_claimed_pod_is_deleted_while_the_gate_is_closed() -> None:
    cluster = Cluster(active="", active_uid="")
    await look(cluster, LEFT)
    assert not cluster.deleted


async def test_a_pod_that_another_monitor_activated_is_not_deleted() -> None:
    cluster = Cluster()
    cluster.named = "uid-2"  # another monitor has put it in control
    await look(cluster, DRIVES, LEFT)
    assert not cluster.deleted


async def test_an_unanswered_deletion_is_retried() -> None:
    cluster: Any = Cluster()
    garbage = GarbageCollection(cluster, cluster, cluster)
    cluster.away = True
    await look(cluster, DRIVES, LEFT, garbage=garbage)
    assert not cluster.deleted
    cluster.away = False
    await look(cluster, DRIVES, LEFT, garbage=garbage)
    assert cluster.deleted == ["spare-2"]


def recovered_from(*uids: str) -> Progress:
    failed = [PodIdentity(name=uid, uid=uid) for uid in uids]
    return Progress.begin("it ended", last_healthy=1.0, detected=2.0, failed=failed)


async def test_a_failed_pod_whose_deletion_failed_is_deleted_soon() -> None:
    cluster: Any = Cluster()
    cluster.state = replace(cluster.state, recovery=recovered_from("uid-3", "uid-gone"))
    await look(cluster, DRIVES, STANDBY, seconds=FAILED_FOR)
    assert cluster.deleted == ["w-1"]


async def test_a_failed_pod_that_became_active_again_is_not_deleted() -> None:
    cluster: Any = Cluster()
    garbage = GarbageCollection(cluster, cluster, cluster)
    cluster.state = replace(cluster.state, recovery=recovered_from("uid-1", "uid-3"))
    await look(cluster, DRIVES, garbage=garbage)
    cluster.state = GateState(epoch=4, active="w-1", active_uid="uid-3")
    await look(cluster, STANDBY, seconds=FAILED_FOR, garbage=garbage)
    cluster.state = GateState(epoch=5, active="spare-1", active_uid="uid-1")
    await look(cluster, DRIVES, STANDBY, seconds=FAILED_FOR, garbage=garbage)
    assert not cluster.deleted, "what it is now is judged anew"


async def test_a_failed_pod_is_remembered_beyond_the_next_recovery() -> None:
    cluster: Any = Cluster()
    garbage = GarbageCollection(cluster, cluster, cluster)
    cluster.state = replace(cluster.state, recovery=recovered_from("uid-3"))
    assert [pod.uid for pod in garbage.failed()] == ["uid-3"], "the next recovery tells of it, and deletes it"
    cluster.state = replace(cluster.state, recovery=recovered_from("uid-4"))
    await look(cluster, DRIVES, STANDBY, seconds=FAILED_FOR, garbage=garbage)
    assert cluster.deleted == ["w-1"]


@pytest.mark.parametrize(("active", "deleted"), [(DRIVES, ["w-1"]), (STANDBY, [])], ids=["another", "the former one"])
async def test_the_former_instance_of_a_switchover_that_a_fence_ended_is_deleted_once_another_one_is_in_control(
    active: Instance, deleted: list[str]
) -> None:
    """It may have failed meanwhile, and nobody would notice (seed 1185758)."""
    cluster: Any = Cluster()
    switchover = Progress(reason="requested", switchover="Failover", former=PodIdentity(name="w-1", uid="uid-3"))
    garbage = GarbageCollection(cluster, cluster, cluster)
    cluster.state = GateState(epoch=4, recovery=ended(switchover))
    garbage.remember()  # during the pause
    cluster.state = GateState(epoch=5, active=active.name, active_uid=active.uid)
    cluster.named = active.uid
    await look(cluster, DRIVES, STANDBY, seconds=FAILED_FOR, garbage=garbage)
    assert cluster.deleted == deleted
