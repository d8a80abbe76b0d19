"""A pod of the workload whose label somebody removed gets it back from the monitor, before the pod counts as gone."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.unit.monitor.act.test_stray_pods import POOL, REPLICA_SET, WORKLOAD, stray
from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects
from tests.unit.monitor.limited_monitor import ACTIVE, World
from understudy.api import names
from understudy.failover.interfaces import GateState, Instance
from understudy.kube import repeated_requests
from understudy.kube.client import PODS, ApiError, Object
from understudy.monitor.act.instances import pod_labels
from understudy.monitor.act.instances.pod_labels import PodLabels
from understudy.monitor.act.recovery.recovery_runner import RecoveryRunner
from understudy.trees.core.health_tree import Verdict

STANDBY = Instance("w-3", "uid-3", ip="10.0.0.3", pool="hot", running=True, ready=True)
OWN = {names.WORKLOAD: "w", names.INSTANCE: "w-3"}


class Labelled:
    """A workload whose monitor knows w-3."""

    def __init__(self, known: Instance = STANDBY) -> None:
        self.objects = ClusterObjects()
        self.objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])
        self.objects.put_pods(known)
        self.objects.put_gate(GateState(epoch=3, active="w-1"))
        self.labels = PodLabels(self.objects.cluster)

    async def look(self) -> None:
        """Look once, and do what follows in the background."""
        self.labels.follow()
        for _ in range(10):
            await asyncio.sleep(0)

    @property
    def requests(self) -> list[str]:
        return [method for method, name, _ in self.objects.client.requests if name == "w-3"]


def vanish(objects: ClusterObjects, pod: Object | None, name: str = "w-3") -> None:
    """The watch reports that a pod is no longer selected. ``pod`` is what the API server has instead; None if it is gone."""
    client = objects.client
    stored = client.store(PODS, NAMESPACE, pod) if pod is not None else client.items.pop((PODS.plural, NAMESPACE, name))
    objects.view.pods.apply_event("DELETED", stored)


@pytest.mark.parametrize("labels", [{}, {names.WORKLOAD: "another"}], ids=["removed", "changed"])
@pytest.mark.parametrize(
    "pod",
    [stray(WORKLOAD), stray(REPLICA_SET), stray(None, workload="w")],
    ids=["standby or claimed", "replica set", "released by its replica set"],
)
async def test_a_pod_that_vanishes_because_of_its_label_gets_it_back_at_once(
    pod: Object, labels: dict[str, str]
) -> None:
    found = Labelled()
    await found.look()
    pod["metadata"]["labels"] = labels
    vanish(found.objects, pod)
    assert not found.objects.pods.of_workload()
    await found.look()
    assert [i.uid for i in found.objects.pods.of_workload()] == ["uid-3"], "it need not wait for the watch"
    body = found.objects.client.requests[-1][2]
    assert body == {"metadata": {"uid": "uid-3", "labels": OWN}}
    ((kind, reason, message),) = found.objects.notices.events
    assert (kind, reason) == ("Warning", "LabelsRestored")
    assert message.startswith("pod w-3")
    await found.look()
    assert found.requests == ["GET", "PATCH"], "once is enough"


@pytest.mark.parametrize(
    "pod",
    [
        None,
        stray(WORKLOAD, uid="uid-4"),
        stray(WORKLOAD, terminating=True),
        stray(WORKLOAD, running=False),
        stray(WORKLOAD, labels=OWN),
        stray(None),
        stray(None, workload="another"),
        stray(REPLICA_SET | {"name": "another"}),
        stray(POOL),
    ],
    ids=["gone", "successor", "deleted", "ended", "labelled", "no owner", "of another", "adopted", "unclaimed"],
)
async def test_no_other_pod_is_labelled(pod: Object | None) -> None:
    found = Labelled()
    await found.look()
    vanish(found.objects, pod)
    for _ in range(3):
        await found.look()
    assert found.requests == ["GET"]
    assert not found.objects.notices.events


async def test_a_pod_that_is_gone_after_its_deletion_is_not_asked_for() -> None:
    found = Labelled(replace(STANDBY, terminating=True))
    await found.look()
    vanish(found.objects, None)
    await found.look()
    assert not found.requests


@pytest.mark.parametrize("error", [OSError("reset"), ApiError(503, "Busy", "later"), ApiError(429, "Busy", "later")])
async def test_it_is_asked_for_until_the_api_server_answers(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(repeated_requests, "RETRY_MOST", 0.0)
    monkeypatch.setattr(repeated_requests, "RETRY_FIRST", 0.0)
    found = Labelled()
    await found.look()
    vanish(found.objects, stray(WORKLOAD))
    for method in ("GET", "PATCH"):
        found.objects.client.failing = lambda asked, name, failing=method: error if asked == failing else None  # type: ignore[misc]
        await found.look()
    found.objects.client.failing = lambda method, name: None
    await found.look()
    assert [i.uid for i in found.objects.pods.of_workload()] == ["uid-3"]


async def test_a_refusal_is_final(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pod_labels, "AGAIN", 0.0)
    found = Labelled()
    await found.look()
    vanish(found.objects, stray(WORKLOAD))
    refused = ApiError(403, "Forbidden", "no")
    found.objects.client.failing = lambda method, name: refused if method == "PATCH" else None
    for _ in range(3):
        await found.look()
    assert found.requests == ["GET", "PATCH"]


async def test_a_new_monitor_asks_for_the_active_pod_if_it_does_not_see_it() -> None:
    found = Labelled()
    found.objects.put_gate(GateState(epoch=4, active="w-3", active_uid="uid-3"))
    vanish(found.objects, stray(WORKLOAD))
    await found.look()
    assert [i.uid for i in found.objects.pods.of_workload()] == ["uid-3"]


@asynccontextmanager
async def running(world: World) -> AsyncIterator[None]:
    """The monitor's loop runs in the context."""
    task = asyncio.create_task(world.loop.run())
    try:
        yield
    finally:
        task.cancel()


async def test_the_active_pod_is_labelled_again_before_it_counts_as_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(monkeypatch, tmp_path)
    world.monitor.observer.health = Verdict("Healthy", "", "", None)
    world.monitor.observer.received_at["w-1"] = time.time() + 60  # it drives on
    async with running(world):
        await world.until(lambda: world.notices.status.health == "Healthy")
        vanish(world.objects, unlabelled(ACTIVE), "w-1")
        await world.until(lambda: world.objects.pods.find("uid-1"))
        world.monitor.observer.received_at.clear()
        await world.until(seen_again(world))
    assert not world.carried_out
    assert world.notices.reasons.count("LabelsRestored") == 1


async def test_labels_are_restored_during_a_recovery_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world, begun = World(monkeypatch, tmp_path), asyncio.Event()

    async def wait(*_: Any) -> None:
        begun.set()
        await asyncio.sleep(60)

    monkeypatch.setattr(RecoveryRunner, "carry_out", wait)
    world.objects.put_pods(ACTIVE, STANDBY)
    world.monitor.observer.health = Verdict("Failed", "no /cmd_vel", "", time.time() - 1)
    async with running(world):
        await asyncio.wait_for(begun.wait(), 5)
        vanish(world.objects, stray(WORKLOAD))
        await world.until(lambda: world.objects.pods.find("uid-3"))


def unlabelled(instance: Instance) -> Object:
    """The pod of an instance of the workload's own ReplicaSet, without its labels."""
    return stray(REPLICA_SET, **{field: getattr(instance, field) for field in ("name", "uid", "ip", "pool")})


def seen_again(world: World) -> Callable[[], bool]:
    """Return a check whether the loop has evaluated once more."""
    before = world.loop.observe.schedule.count
    return lambda: world.loop.observe.schedule.count > before
