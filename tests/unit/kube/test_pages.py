"""A long list comes in parts, all of one moment, and what is the same again isn't read again."""

from __future__ import annotations

import asyncio
import gc
import json
import math
from collections.abc import Iterator, Mapping

import pytest

from understudy.api.names import COMPONENT
from understudy.controller.reconcile.object_store import Store
from understudy.controller.runtime import resync
from understudy.controller.runtime.resync import ListCycle
from understudy.kube.client import CONFIG_MAPS, PODS, WORKLOADS, Client, Object, Part


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Server(Client):
    """So many pods, and nothing else."""

    def __init__(self, count: int) -> None:
        self.pods = {f"w-{number:03}": pod(f"w-{number:03}") for number in range(count)}
        self.version = 7
        self.asked: list[dict[str, str]] = []

    def change(self, name: str) -> None:
        self.version += 1
        self.pods[name] = pod(name, version=self.version)

    async def read(self, path: str, *, params: Mapping[str, str] | None = None) -> bytes:
        asked = dict(params or {})
        self.asked.append(asked)
        kind = "PodList" if path.endswith("/pods") else "OtherList"
        matching = list(self.pods) if kind == "PodList" and asked.get("labelSelector") == "app" else []
        first, limit = int(asked.get("continue", "0")), int(asked["limit"])
        part, rest = matching[first : first + limit], matching[first + limit :]
        more = {"continue": str(first + limit)} if rest else {}
        # Later parts are of the moment of the first one, and say so.
        metadata = {"resourceVersion": str(self.version), **more}
        items = [self.pods[name] for name in part]
        return compact({"kind": kind, "apiVersion": "v1", "metadata": metadata, "items": items})


def pod(name: str, version: int = 5) -> Object:
    return {"metadata": {"name": name, "namespace": "fleet", "uid": name, "resourceVersion": str(version)}}


def compact(value: Object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


async def names(client: Client, limit: int) -> list[list[str]]:
    parts = client.parts(PODS, "fleet", labels="app", limit=limit)
    return [[item["metadata"]["name"] for item in part.items()] async for part in parts]


async def test_each_page_is_requested_from_the_end_of_the_previous_one() -> None:
    server = Server(7)
    assert await names(server, 3) == [["w-000", "w-001", "w-002"], ["w-003", "w-004", "w-005"], ["w-006"]]
    assert [asked.get("continue") for asked in server.asked] == [None, "3", "6"]
    assert {asked["labelSelector"] for asked in server.asked} == {"app"}


async def test_a_short_list_has_one_page() -> None:
    assert await names(Server(3), 3) == [["w-000", "w-001", "w-002"]]
    assert await names(Server(0), 3) == [[]]


ROBOTS: Object = {
    "kind": "RobotWorkloadList",
    "apiVersion": WORKLOADS.group,
    "metadata": {"resourceVersion": "7"},
    "items": [{"metadata": {"name": 'a"],[{'}, "spec": {"items": [1, [2]]}}, {"metadata": {"name": "ü"}}],
}


@pytest.mark.parametrize("keys", [list(ROBOTS), sorted(ROBOTS)], ids=["built-in", "custom"])
@pytest.mark.parametrize("separators", [(",", ":"), (", ", ": ")], ids=["compact", "spaced"])
@pytest.mark.parametrize("indent", [None, 1])
def test_a_list_is_read_in_any_order_of_its_fields(
    keys: list[str], separators: tuple[str, str], indent: int | None
) -> None:
    """Lists of custom resources have their metadata behind the objects."""
    text = json.dumps({key: ROBOTS[key] for key in keys}, separators=separators, indent=indent)
    part = Part.of(text.encode())
    kind = {"apiVersion": WORKLOADS.group, "kind": "RobotWorkload"}
    assert list(part.items()) == [{**kind, **item} for item in ROBOTS["items"]]
    assert part.head["metadata"] == ROBOTS["metadata"]


@pytest.mark.parametrize("items", [{}, {"items": None}, {"items": []}])
def test_a_list_without_objects_has_none(items: Object) -> None:
    assert list(Part.of(compact({"kind": "PodList", "apiVersion": "v1", "metadata": {}, **items})).items()) == []


@pytest.fixture
def only_pods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resync, "LISTED", ((PODS, ("app",)), (CONFIG_MAPS, (None,))))


async def test_every_list_is_complete_for_any_page_size(only_pods: None) -> None:
    server, store = Server(1001), Store()
    lists = ListCycle(server, store, ())
    sights = await lists.resync()
    assert len(sights) == len(store.all(PODS)) == 1001
    assert len(server.asked) > 4, "in more than one part"
    assert not await lists.resync(), "nothing has changed"


async def test_a_background_list_pauses_after_each_page(only_pods: None, monkeypatch: pytest.MonkeyPatch) -> None:
    rests: list[float] = []

    async def sleep(seconds: float) -> None:
        rests.append(seconds)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    clock = Clock()
    server, store = Server(600), Store(clock=clock)
    lists = ListCycle(server, store, ())
    await lists.resync()
    assert not rests, "who waits for it isn't kept waiting"
    server.asked.clear()
    clock.now += 1.0
    await lists.resync(gently=True)
    assert len(rests) == len(server.asked) == 4
    assert all(0 < rest <= resync.REST_MOST for rest in rests)
    assert len(store.all(PODS)) == 600


async def test_the_decoding_of_a_long_list_lets_others_run(only_pods: None) -> None:
    server, turns = Server(20), 0
    for item in server.pods.values():
        item["spec"] = {"arguments": [[number] for number in range(60_000)]}

    async def other() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    async with asyncio.TaskGroup() as group:
        running = group.create_task(other())
        await ListCycle(server, Store(), ()).resync()
        running.cancel()
    assert turns >= 5, "decoding takes 0.4 s of processor time"


async def test_a_background_list_yields_to_watches_but_not_forever(
    only_pods: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, slept, until = Clock(), 0.0, 0.0
    server, store = Server(600), Store(clock=clock)
    lists = ListCycle(server, store, ())
    await lists.resync()
    pod = store.all(PODS)[0]

    async def sleep(seconds: float) -> None:
        nonlocal slept
        slept, clock.now = slept + seconds, clock.now + seconds
        if slept <= until:
            version = str(int(pod["metadata"]["resourceVersion"]) + round(1000 * clock.now))
            store.put(PODS, {**pod, "metadata": {**pod["metadata"], "resourceVersion": version}})

    monkeypatch.setattr(asyncio, "sleep", sleep)
    for busy, least, most in ((3.0, 3.0, 5.0), (math.inf, resync.PATIENCE, resync.PATIENCE + 2.0)):
        slept, until = 0.0, busy
        await lists.resync(gently=True)
        assert least <= slept <= most


async def test_only_changed_objects_are_decoded_again(only_pods: None, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []
    items = Part.items

    def counted(part: Part) -> Iterator[Object]:
        for item in items(part):
            decoded.append(item["metadata"]["name"])
            yield item

    monkeypatch.setattr(Part, "items", counted)
    server, store = Server(600), Store()
    lists = ListCycle(server, store, ())
    await lists.resync()
    decoded.clear()
    server.change("w-300")
    (sight,) = await lists.resync()
    assert sight.new is store.get(PODS, "fleet", "w-300")
    assert decoded == [f"w-{number}" for number in range(250, 500)], "the part that it is in"


async def test_an_unchanged_list_corrects_a_wrong_watch_event(only_pods: None) -> None:
    server, store = Server(3), Store()
    lists = ListCycle(server, store, ())
    await lists.resync()
    gone = pod("w-gone")
    store.put(PODS, {**gone, "metadata": {**gone["metadata"], "labels": {COMPONENT: "instance"}}})
    (sight,) = await lists.resync()
    assert sight.new is None, "it isn't there"
    server.change("w-001")
    store.put(PODS, pod("w-001", version=server.version))
    assert not await lists.resync(), "a watch was faster"
    found = store.get(PODS, "fleet", "w-001")
    assert found is not None
    assert found["metadata"]["resourceVersion"] == str(server.version)


async def test_a_list_shares_its_objects_with_the_store(only_pods: None) -> None:
    """Or every object of a fleet would be in memory twice."""
    server, store = Server(3), Store()
    lists = ListCycle(server, store, ())
    before = pods_in_memory()
    await lists.resync()
    found = [item for item in pods_in_memory() if not any(item is one for one in before)]
    assert sorted(map(id, found)) == sorted(map(id, store.all(PODS)))
    assert not await lists.resync(), "it remembers what it listed"


def pods_in_memory() -> list[Object]:
    """Every pod of :func:`pod` that something in this process still holds."""
    gc.collect()
    wanted = {"name", "namespace", "uid", "resourceVersion"}
    return [
        item
        for item in gc.get_objects()
        if type(item) is dict and isinstance(item.get("metadata"), dict) and wanted <= item["metadata"].keys()
    ]
