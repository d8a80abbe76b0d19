"""A long list comes in parts, all of one moment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from understudy.cluster.client import CONFIG_MAPS, PODS, Client, Object
from understudy.controller.resyncing import resync
from understudy.controller.stores import Store


class Server(Client):
    """So many pods, and nothing else."""

    def __init__(self, count: int) -> None:
        self._names = [f"w-{number:03}" for number in range(count)]
        self.asked: list[dict[str, str]] = []

    async def request(self, method: str, path: str, *, params: Mapping[str, str] | None = None, **_: Any) -> Object:
        asked = dict(params or {})
        self.asked.append(asked)
        kind = "PodList" if path.endswith("/pods") else "OtherList"
        matching = self._names if kind == "PodList" and asked.get("labelSelector") == "app" else []
        first, limit = int(asked.get("continue", "0")), int(asked["limit"])
        part, rest = matching[first : first + limit], matching[first + limit :]
        more = {"continue": str(first + limit)} if rest else {}
        items = [
            {"metadata": {"name": name, "namespace": "fleet", "uid": name, "resourceVersion": "5"}} for name in part
        ]
        # Later parts are of the moment of the first one, and say so.
        return {"kind": kind, "apiVersion": "v1", "metadata": {"resourceVersion": "7", **more}, "items": items}


async def names(client: Client, limit: int) -> list[list[str]]:
    pages = client.pages(PODS, "fleet", labels="app", limit=limit)
    return [[item["metadata"]["name"] for item in part["items"]] async for part in pages]


async def test_every_part_is_asked_for_where_the_last_one_ended() -> None:
    server = Server(7)
    assert await names(server, 3) == [["w-000", "w-001", "w-002"], ["w-003", "w-004", "w-005"], ["w-006"]]
    assert [asked.get("continue") for asked in server.asked] == [None, "3", "6"]
    assert {asked["labelSelector"] for asked in server.asked} == {"app"}


async def test_a_short_list_is_one_part() -> None:
    assert await names(Server(3), 3) == [["w-000", "w-001", "w-002"]]
    assert await names(Server(0), 3) == [[]]


async def test_everything_is_listed_whole_whatever_its_parts(monkeypatch: Any) -> None:
    monkeypatch.setattr("understudy.controller.resyncing.LISTED", ((PODS, ("app",)), (CONFIG_MAPS, (None,))))
    server, store = Server(1001), Store()
    sights = await resync(server, store, ())
    assert len(sights) == len(store.all(PODS)) == 1001
    assert len(server.asked) > 4, "in more than one part"
    assert not await resync(server, store, ()), "nothing has changed"
