"""The writers of a graph are followed: each is learned as soon as discovery reports it, and forgotten when it is gone."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

from understudy.ros.observe import writer_instances
from understudy.ros.observe.writer_instances import LIST_PERIOD, WriterInstances

ONE, OTHER = b"1" * 16, b"2" * 16


class Discovery:
    """Reports the instances of writers, once it knows them."""

    def __init__(self) -> None:
        self.knows: dict[bytes, str] = {}
        self.asked = 0

    async def instances_of_writers(self, wanted: Collection[bytes], *_: object, within: float) -> Mapping[bytes, str]:
        self.asked += 1
        await asyncio.sleep(0.01)
        return {gid: name for gid, name in self.knows.items() if gid in wanted}


@pytest.fixture
def discovery(monkeypatch: pytest.MonkeyPatch) -> Discovery:
    found = Discovery()
    monkeypatch.setattr(
        writer_instances, "MIDDLEWARE", SimpleNamespace(instances_of_writers=found.instances_of_writers)
    )
    return found


@asynccontextmanager
async def following(found: WriterInstances, present: set[bytes], learned: list[Any]) -> AsyncIterator[None]:
    def look() -> set[bytes]:
        return set(present)

    running = asyncio.create_task(found.follow(lambda: len(present), look, lambda: learned.append(dict(found.names))))
    try:
        yield
    finally:
        running.cancel()


async def test_a_writer_that_discovery_has_not_reported_in_time_is_asked_for_again_at_once(
    discovery: Discovery,
) -> None:
    found, learned = WriterInstances("127.0.0.1"), list[Any]()
    async with following(found, {ONE}, learned), asyncio.timeout(LIST_PERIOD):
        while discovery.asked < 3:
            await asyncio.sleep(0.01)
        assert learned == []
        discovery.knows[ONE] = "w-1"
        while not learned:
            await asyncio.sleep(0.01)
    assert learned == [{ONE: "w-1"}]


async def test_nobody_is_asked_about_writers_that_are_known_and_one_that_is_gone_is_forgotten(
    discovery: Discovery,
) -> None:
    found, learned, present = WriterInstances("127.0.0.1"), list[Any](), {ONE, OTHER}
    discovery.knows = {ONE: "w-1", OTHER: ""}
    async with following(found, present, learned):
        await asyncio.sleep(0.7)
        assert (discovery.asked, found.names) == (1, {ONE: "w-1", OTHER: ""})
        present.remove(ONE)
        async with asyncio.timeout(LIST_PERIOD):
            while ONE in found.names:
                await asyncio.sleep(0.01)
    assert discovery.asked == 1
