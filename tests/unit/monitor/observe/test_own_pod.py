"""A monitor whose pod was deleted while it could not reach the API server ends, as its node's kubelet ends it only later."""

from __future__ import annotations

import asyncio

import pytest

from tests.unit.kube.memory import MemoryClient
from understudy.failover.progress import PodIdentity
from understudy.kube.client import PODS, Object
from understudy.monitor.observe.objects import own_pod
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.objects.own_pod import (
    PodDeleted,
    end_at_start_if_deleted,
    end_if_deleted,
    is_confirmed,
)
from understudy.monitor.observe.wakeups import Wakeups

ME = PodIdentity(name="w-monitor-1", uid="uid-1")


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_pod, "REPORTED_WITHIN", 0.01)


@pytest.fixture
def view() -> ClusterView:
    return ClusterView(MemoryClient(), "n", "w", Wakeups(), me=ME)


def put(view: ClusterView, uid: str = ME.uid, **metadata: str) -> None:
    item: Object = {"metadata": {"name": ME.name, "uid": uid, **metadata}}
    view.client.store(PODS, "n", item)  # type: ignore[attr-defined]


async def outage(view: ClusterView) -> None:
    """The API server does not answer, and then it does."""
    client = view.client
    client.failing = lambda method, name: OSError("unreachable")  # type: ignore[attr-defined]
    with pytest.raises(OSError, match="unreachable"):
        await client.get(PODS, "n", "any")
    client.failing = lambda method, name: None  # type: ignore[attr-defined]
    await client.list(PODS, "n")


@pytest.mark.parametrize("how", ["being deleted", "gone", "another of the same name"])
async def test_a_monitor_whose_pod_was_deleted_during_an_outage_ends(view: ClusterView, how: str) -> None:
    if how == "being deleted":
        put(view, deletionTimestamp="2026-01-01T00:00:30Z")
    elif how != "gone":
        put(view, uid="uid-2")
    ending = asyncio.create_task(end_if_deleted(view))
    await outage(view)
    with pytest.raises(PodDeleted, match=r"pod w-monitor-1 was deleted"):
        await asyncio.wait_for(ending, 5)
    assert view.pod_deleted, "the action proxy learns of it first"


async def test_a_monitor_whose_pod_exists_goes_on_after_each_outage(view: ClusterView) -> None:
    put(view)
    going_on = asyncio.create_task(end_if_deleted(view))
    for _ in range(2):
        await outage(view)
        await asyncio.sleep(0.05)
        assert not going_on.done()
        assert is_confirmed(view)
    put(view, deletionTimestamp="2026-01-01T00:00:30Z")
    await asyncio.sleep(0.05)
    assert not going_on.done(), "its kubelet ends it: there was no outage"
    going_on.cancel()


async def test_a_pod_is_not_confirmed_before_the_api_server_was_asked_for_it_after_an_outage(view: ClusterView) -> None:
    put(view)
    confirming = asyncio.create_task(end_if_deleted(view))
    await outage(view)
    assert not is_confirmed(view)
    await asyncio.sleep(0.05)
    assert is_confirmed(view)
    confirming.cancel()


async def test_a_monitor_that_is_started_again_in_a_deleted_pod_ends_before_it_does_anything(view: ClusterView) -> None:
    put(view, deletionTimestamp="2026-01-01T00:00:30Z")
    with pytest.raises(PodDeleted, match=r"pod w-monitor-1 was deleted"):
        await end_at_start_if_deleted(view)
    put(view)
    await end_at_start_if_deleted(view)


async def test_a_silent_api_server_does_not_delay_the_start(view: ClusterView, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_pod, "ASKED_WITHIN", 0.05)
    view.client.failing = lambda method, name: TimeoutError()  # type: ignore[attr-defined]
    await asyncio.wait_for(end_at_start_if_deleted(view), 5)
