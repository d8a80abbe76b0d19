"""A local copy that a watch and writes update: neither replaces newer knowledge of the other."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from understudy.kube import watched_collection
from understudy.kube.client import PODS, Client, Object
from understudy.kube.watched_collection import Reflector, any_changed


def pod(name: str, version: int, **labels: str) -> Object:
    return {"metadata": {"name": name, "uid": f"uid-{name}", "resourceVersion": str(version), "labels": labels}}


class Scripted(Client):
    """Answers a list with the given objects, and then sends the events from a queue."""

    def __init__(self, version: int, *items: Object) -> None:
        self.version, self.items = version, items
        self.lists = 0
        self.events: asyncio.Queue[tuple[str, Object]] = asyncio.Queue()
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    async def list(self, *_: Any, **__: Any) -> Object:
        self.lists += 1
        await self.may_answer.wait()
        return {"metadata": {"resourceVersion": str(self.version)}, "items": list(self.items)}

    async def watch(self, *_: Any, **__: Any) -> AsyncIterator[tuple[str, Object]]:
        while True:
            yield await self.events.get()


@contextlib.asynccontextmanager
async def following(client: Scripted) -> AsyncIterator[Reflector]:
    reflector = Reflector(client, PODS, "fleet")
    task = asyncio.create_task(reflector.run())
    try:
        yield reflector
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def deliver(client: Scripted, kind: str, item: Object) -> None:
    client.events.put_nowait((kind, item))
    for _ in range(5):
        await asyncio.sleep(0)


def known(reflector: Reflector) -> dict[str, str]:
    return {name: item["metadata"]["resourceVersion"] for name, item in reflector.items.items()}


async def test_a_late_watch_event_does_not_undo_our_own_write() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 6))
        reflector.put(pod("a", 7))
        await deliver(client, "MODIFIED", pod("a", 6))
        assert known(reflector) == {"a": "7"}
        await deliver(client, "MODIFIED", pod("a", 7))
        await deliver(client, "MODIFIED", pod("a", 8))
        assert known(reflector) == {"a": "8"}


async def test_a_late_answer_does_not_restore_a_deleted_object() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        await deliver(client, "DELETED", pod("a", 9))
        reflector.put(pod("a", 8))
        assert known(reflector) == {}


async def test_a_new_object_with_the_name_of_a_deleted_one_is_kept() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 10))
        await deliver(client, "DELETED", pod("a", 9))
        assert known(reflector) == {"a": "10"}


async def test_a_write_during_a_list_may_be_newer_than_the_list() -> None:
    client = Scripted(5, pod("a", 4), pod("b", 5))
    client.may_answer.clear()
    async with following(client) as reflector:
        await asyncio.sleep(0)
        reflector.put(pod("a", 6))
        reflector.put(pod("b", 3))
        reflector.put(pod("c", 7))
        reflector.put(pod("d", 4))
        client.may_answer.set()
        await reflector.synced.wait()
        assert known(reflector) == {"a": "6", "b": "5", "c": "7"}


async def test_a_bookmark_confirms_all_earlier_versions() -> None:
    client = Scripted(5)
    async with following(client) as reflector:
        await reflector.synced.wait()
        await deliver(client, "BOOKMARK", pod("", 20))
        reflector.put(pod("a", 15))
        assert known(reflector) == {}
        reflector.put(pod("a", 21))
        assert known(reflector) == {"a": "21"}


async def test_a_watch_that_reports_what_is_expected_in_time_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_collection, "LATE", 0.05)
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 6))
        await deliver(client, "MODIFIED", pod("a", 6))
        reflector.expect(pod("a", 6))
        reflector.expect(pod("of another workload", 9))
        await asyncio.sleep(0.1)
        assert client.lists == 1


async def test_a_watch_that_reports_only_earlier_versions_has_its_time_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_collection, "LATE", 0.2)
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 7))
        await asyncio.sleep(0.15)
        await deliver(client, "MODIFIED", pod("a", 6))
        await asyncio.sleep(0.1)
        assert client.lists == 1
        client.version = 7
        await asyncio.sleep(0.2)
        assert client.lists == 2


async def test_what_was_put_during_a_list_is_expected_of_the_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next list ends that, even if an API server that was restored from a backup has only earlier versions."""
    monkeypatch.setattr(watched_collection, "LATE", 0.05)
    client = Scripted(5, pod("a", 5))
    client.may_answer.clear()
    async with following(client) as reflector:
        await asyncio.sleep(0)
        reflector.put(pod("a", 6))
        client.may_answer.set()
        await asyncio.sleep(0.3)
        assert client.lists == 2


async def test_an_object_that_an_answer_took_for_gone_is_listed_again_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_collection, "LATE", 0.2)
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.doubt("b", "uid-b")
        reflector.doubt("a", "uid of its predecessor")
        await asyncio.sleep(0.25)
        assert client.lists == 1
        reflector.doubt("a", "uid-a")
        await asyncio.sleep(0.05)
        assert client.lists == 2
        reflector.doubt("a", "uid-a")
        await asyncio.sleep(0.05)
        assert client.lists == 2, "writes that are refused again and again cost few lists"
        await asyncio.sleep(0.2)
        assert client.lists == 3


async def test_a_watch_that_reports_something_has_no_need_of_a_list_after_a_doubt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watched_collection, "LATE", 0.05)
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.doubt("a", "uid-a")
        await deliver(client, "DELETED", pod("a", 6))
        await asyncio.sleep(0.1)
        assert (known(reflector), client.lists) == ({}, 1)


async def test_the_first_change_of_several_ends_the_wait_for_all() -> None:
    class Source:
        def __init__(self) -> None:
            self.event, self.waiting = asyncio.Event(), 0

        async def changed(self) -> None:
            self.waiting += 1
            try:
                await self.event.wait()
            finally:
                self.waiting -= 1

    sources = [Source(), Source()]
    waiting = asyncio.ensure_future(any_changed(sources))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert [source.waiting for source in sources] == [1, 1]
    sources[1].event.set()
    await asyncio.wait_for(waiting, 5)
    await asyncio.sleep(0)
    assert [source.waiting for source in sources] == [0, 0]


async def test_a_change_between_the_request_and_the_wait_is_not_missed() -> None:
    client = Scripted(5)
    async with following(client) as reflector:
        await reflector.synced.wait()
        waiting = asyncio.ensure_future(any_changed((reflector,)))
        # It comes as soon as the wait has begun, before anything that it began has run.
        asyncio.get_running_loop().call_soon(reflector.put, pod("a", 6))
        await asyncio.wait_for(waiting, 5)
