"""A local copy that a watch and writes update: neither replaces newer knowledge of the other."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from understudy.kube.client import PODS, Client, Object
from understudy.kube.watched_collection import Reflector, any_changed


def pod(name: str, version: int, **labels: str) -> Object:
    return {"metadata": {"name": name, "uid": f"uid-{name}", "resourceVersion": str(version), "labels": labels}}


class Scripted(Client):
    """Answers a list with the given objects, and then sends the events from a queue."""

    def __init__(self, version: int, *items: Object) -> None:
        self.version, self.items = version, items
        self.events: asyncio.Queue[tuple[str, Object]] = asyncio.Queue()
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    async def list(self, *_: Any, **__: Any) -> Object:
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
