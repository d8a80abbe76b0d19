"""Watches continue where they ended, and list again if the changes since then are no longer known."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from typing import Any

import aiohttp
import pytest

from tests.unit.controller.world import pod, standby_pod, workload
from understudy.controller.reconcile.object_store import Store
from understudy.controller.runtime import watches
from understudy.controller.runtime.resync import TREES, ListCycle
from understudy.kube.api_contact import ApiContact
from understudy.kube.client import CONFIG_MAPS, NODES, PODS, ApiError, Client, Expired, Object, Part, Resource

Event = tuple[str, Object]
BOOKMARK = "BOOKMARK"
SURPRISING = "surprising"


def watch_event(kind: str, name: str, version: int) -> Event:
    item = pod(name)
    return kind, {**item, "metadata": {**item["metadata"], "resourceVersion": str(version)}}


class Scripted(Client):
    """Watches of pods that bring some events and then end on command; all others are silent."""

    def __init__(self, *scripts: tuple[Sequence[Event], Exception | None]) -> None:
        self.contact = ApiContact()
        self._scripts = iter(scripts)
        self.started: list[str] = []
        self.asked: list[tuple[Resource, str | None, str | None]] = []
        self.over = asyncio.Event()

    async def watch(
        self, resource: Resource, namespace: str | None = None, *, version: str, labels: str | None = None, **_: Any
    ) -> AsyncIterator[Event]:
        self.asked.append((resource, namespace, labels))
        if resource == PODS:
            self.started.append(version)
            script = next(self._scripts, None)
            if script is not None:
                events, error = script
                for event in events:
                    yield event
                if error is not None:
                    raise error
                return
            self.over.set()
        await asyncio.Event().wait()


async def watched(client: Scripted, *namespaces: str) -> list[tuple[str, bool]]:
    """The pods that were seen, and whether they are gone, until the scripts are over."""
    events: list[tuple[str, bool]] = []

    def see(resource: Resource, item: Object, gone: bool) -> None:
        if item["metadata"]["name"] == SURPRISING:
            raise KeyError("spec")
        events.append((item["metadata"]["name"], gone))

    task = asyncio.create_task(watches.watch(client, see, namespaces))
    async with asyncio.timeout(5):
        await client.over.wait()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return events


async def test_a_watch_resumes_at_the_version_where_the_last_one_ended() -> None:
    first = [watch_event("ADDED", "a", 3), watch_event(BOOKMARK, "", 7), watch_event("DELETED", "a", 9)]
    client = Scripted((first, None), ([], None))
    assert await watched(client) == [("a", False), ("a", True)]
    assert client.started == [watches.BEGINNING, "9", "9"]


async def test_a_watch_without_a_bookmark_starts_from_the_beginning() -> None:
    """Objects come in the order of their names, not of their versions."""
    client = Scripted(
        ([watch_event("ADDED", "a", 9), watch_event("ADDED", "b", 3)], aiohttp.ClientPayloadError("broken")), ([], None)
    )
    await watched(client)
    assert client.started == [watches.BEGINNING] * 3


async def test_an_expired_version_starts_the_watch_from_the_beginning() -> None:
    client = Scripted(([watch_event(BOOKMARK, "", 7)], None), ([], Expired()))
    await watched(client)
    assert client.started == [watches.BEGINNING, "7", watches.BEGINNING]


@pytest.mark.parametrize("error", [aiohttp.ServerDisconnectedError(), TimeoutError(), OSError("down")])
async def test_a_connection_error_does_not_end_the_watch(error: Exception) -> None:
    client = Scripted(([watch_event(BOOKMARK, "", 7)], error), ([watch_event("ADDED", "b", 8)], None))
    assert await watched(client) == [("b", False)]
    assert client.started == [watches.BEGINNING, "7", "8"]


async def test_an_object_that_causes_an_error_does_not_block_others() -> None:
    client = Scripted(([watch_event("ADDED", SURPRISING, 3), watch_event("ADDED", "b", 4)], None))
    assert await watched(client) == [("b", False)]


async def test_nodes_are_watched_in_the_cluster_and_config_maps_by_label() -> None:
    client = Scripted()
    await watched(client, "one", "two")
    await asyncio.sleep(0)
    assert [namespace for resource, namespace, _ in client.asked if resource == NODES] == [None]
    assert [(namespace, labels) for resource, namespace, labels in client.asked if resource == CONFIG_MAPS] == [
        ("one", TREES),
        ("two", TREES),
    ]


class WithoutLabels(Client):
    """Has pods of Understudy that no list by label contains."""

    def __init__(self, *names_: str) -> None:
        self.names = names_

    async def parts(self, *_: Any, **__: Any) -> AsyncIterator[Part]:
        yield Part.of(b'{"kind":"List","apiVersion":"v1","metadata":{"resourceVersion":"9"},"items":[]}')

    async def get(self, resource: Resource, namespace: str | None, name: str) -> Object:
        if name not in self.names:
            raise ApiError(404, "NotFound", name)
        return unlabelled(name)


def unlabelled(name: str) -> Object:
    item = standby_pod(name, of=workload("w"))
    return {**item, "metadata": {**item["metadata"], "labels": {}}}


async def test_a_list_finds_that_a_pod_is_gone_whose_labels_somebody_had_removed() -> None:
    """Its watch may have missed that, and no list contains it."""
    store = Store()
    for name in ("w-1", "w-2"):
        store.put(PODS, unlabelled(name))
    changes = await ListCycle(WithoutLabels("w-1"), store, ()).resync()
    assert [one.old["metadata"]["name"] for one in changes if one.old is not None and one.new is None] == ["w-2"]
    assert [item["metadata"]["name"] for item in store.all(PODS)] == ["w-1"]
