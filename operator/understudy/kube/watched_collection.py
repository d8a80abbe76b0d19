"""A local copy of a collection, kept up to date by list and watch, so that the fast path never has to ask.

The results of our own writes are also put into it. They arrive before or after the watch's event of the same change.
The versions decide which is newer (they are comparable within a resource, KEP-5504).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import zlib
from collections.abc import Awaitable, Callable, Iterable
from typing import Protocol

from understudy.kube.client import FAILURES, Client, Expired, Object, Resource

_logger = logging.getLogger(__name__)

RETRY_FIRST, RETRY_MOST = 0.2, 5.0  # seconds


class Reflector:
    """The objects of one resource by name, as the API server last reported them."""

    def __init__(
        self,
        client: Client,
        resource: Resource,
        namespace: str,
        *,
        labels: str | None = None,
        fields: str | None = None,
        cached: bool = False,
        on_change: Callable[[], None] | None = None,
    ) -> None:
        """``on_change`` is called whenever an object is new, changed or deleted.

        ``cached`` is passed to :meth:`Client.list`.
        """
        self._client, self._resource, self._namespace = client, resource, namespace
        self._labels, self._fields, self._cached = labels, fields, cached
        self._on_change = on_change
        self._stagger = 0.5 + zlib.crc32(f"{resource.plural} {labels} {fields}".encode()) % 100 / 200
        """So that a process notices the API server's return by one of its watches, and does not ask with all of them at once."""
        self._changed = asyncio.Event()
        self._reported = 0
        """The version up to which the last list and the watch have reported everything."""
        self.items: dict[str, Object] = {}
        self.revision = 0
        """Grows with every change, for caches of values derived from the objects."""
        self.synced = asyncio.Event()

    async def run(self) -> None:
        """List and watch until cancelled, whatever errors occur."""
        retry = RETRY_FIRST
        while True:
            try:
                version = await self._relist()
                retry = RETRY_FIRST
                while True:
                    version = await self._follow(version)
            except Expired:
                continue
            except FAILURES as error:
                level = logging.DEBUG if retry == RETRY_FIRST else logging.WARNING
                _logger.log(level, "watching %s in %s: %s", self._resource.plural, self._namespace, error)
                await self._client.contact.pause(retry * self._stagger)
                retry = min(retry * 2, RETRY_MOST)

    async def _relist(self) -> str:
        before = dict(self.items)
        answer = await self._client.list(
            self._resource, self._namespace, labels=self._labels, fields=self._fields, cached=self._cached
        )
        version: str = answer["metadata"]["resourceVersion"]
        self._reported = version_of(answer)
        fresh = {item["metadata"]["name"]: item for item in answer.get("items") or []}
        # An object that was put while the list was in progress may be newer than the list.
        newer = {n for n, i in self.items.items() if before.get(n) is not i and version_of(i) > self._reported}
        for name in [n for n in self.items if n not in fresh and n not in newer]:
            self._set(name, None)
        for name, item in fresh.items():
            known = self.items.get(name, {}).get("metadata", {}).get("resourceVersion")
            if name not in newer and known != item["metadata"]["resourceVersion"]:
                self._set(name, item)
        self.synced.set()
        self._notify()
        return version

    async def _follow(self, version: str) -> str:
        events = self._client.watch(
            self._resource, self._namespace, version=version, labels=self._labels, fields=self._fields
        )
        async with contextlib.aclosing(events):  # type: ignore[type-var]
            async for kind, item in events:
                version = item["metadata"]["resourceVersion"]
                self.apply_event(kind, item)
        return version

    def apply_event(self, kind: str, item: Object) -> None:
        """Apply an event of the watch. It is ignored if a later state of the object is known."""
        self._reported = max(self._reported, version_of(item))
        if kind == "BOOKMARK" or version_of(self.items.get(item["metadata"]["name"])) > version_of(item):
            return
        self._set(item["metadata"]["name"], None if kind == "DELETED" else item)
        self._notify()

    def put(self, item: Object) -> None:
        """Store an object that a write of ours returned.

        It is ignored if the watch has reported a later state, which may be the object's deletion.
        """
        name = item["metadata"]["name"]
        known = self.items.get(name)
        if known is not None and version_of(known) >= version_of(item):
            return
        if 0 < version_of(item) <= self._reported:
            return
        self._set(name, item)
        self._notify()

    def _set(self, name: str, item: Object | None) -> None:
        old = self.items.pop(name, None)
        if item is not None:
            self.items[name] = item
        if item is None and old is None:
            return
        self.revision += 1
        if self._on_change is not None:
            self._on_change()

    def _notify(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()

    def changed(self) -> Awaitable[object]:
        """Return an awaitable that ends with the next change from now on.

        It also ends if that change comes before the caller awaits it.
        """
        return self._changed.wait()


class Watchable(Protocol):
    """Something that can change."""

    def changed(self) -> Awaitable[object]:
        """Return an awaitable that ends with the next change."""


async def any_changed(sources: Iterable[Watchable]) -> None:
    """Wait until the first of these sources changes."""
    waits = [asyncio.ensure_future(source.changed()) for source in sources]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waits:
            task.cancel()


def version_of(item: Object | None) -> int:
    """Return the version of an object or a list; 0 if there is no object or its version is not a number."""
    text = item["metadata"].get("resourceVersion", "0") if item is not None else "0"
    return int(text) if text.isdigit() else 0
