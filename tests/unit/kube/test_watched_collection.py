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


async def told(client: Scripted, kind: str, item: Object) -> None:
    client.events.put_nowait((kind, item))
    for _ in range(5):
        await asyncio.sleep(0)


def known(reflector: Reflector) -> dict[str, str]:
    return {name: item["metadata"]["resourceVersion"] for name, item in reflector.items.items()}


async def test_a_watch_that_is_late_takes_nothing_of_our_own_writes_back() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 6))
        reflector.put(pod("a", 7))
        await told(client, "MODIFIED", pod("a", 6))
        assert known(reflector) == {"a": "7"}
        await told(client, "MODIFIED", pod("a", 7))
        await told(client, "MODIFIED", pod("a", 8))
        assert known(reflector) == {"a": "8"}


async def test_an_answer_that_is_late_does_not_bring_back_what_is_gone() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        await told(client, "DELETED", pod("a", 9))
        reflector.put(pod("a", 8))
        assert known(reflector) == {}


async def test_a_new_object_of_a_gone_one_s_name_is_not_taken_away_with_it() -> None:
    client = Scripted(5, pod("a", 5))
    async with following(client) as reflector:
        await reflector.synced.wait()
        reflector.put(pod("a", 10))
        await told(client, "DELETED", pod("a", 9))
        assert known(reflector) == {"a": "10"}


async def test_what_is_written_while_a_list_is_under_way_may_be_newer_than_it() -> None:
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


async def test_what_a_bookmark_has_passed_is_known() -> None:
    client = Scripted(5)
    async with following(client) as reflector:
        await reflector.synced.wait()
        await told(client, "BOOKMARK", pod("", 20))
        reflector.put(pod("a", 15))
        assert known(reflector) == {}
        reflector.put(pod("a", 21))
        assert known(reflector) == {"a": "21"}


async def test_of_several_the_first_that_changes_is_enough_and_nobody_goes_on_waiting_for_the_others() -> None:
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


async def test_a_change_between_asking_for_it_and_waiting_for_it_is_not_missed() -> None:
    client = Scripted(5)
    async with following(client) as reflector:
        await reflector.synced.wait()
        waiting = asyncio.ensure_future(any_changed((reflector,)))
        # It comes as soon as the wait has begun, before anything that it began has run.
        asyncio.get_running_loop().call_soon(reflector.put, pod("a", 6))
        await asyncio.wait_for(waiting, 5)
