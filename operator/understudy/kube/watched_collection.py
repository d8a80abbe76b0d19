"""A local copy of a collection, kept up to date by list and watch, so that the fast path never has to ask.

The results of our own writes are also put into it. They arrive before or after the watch's event of the same change.
The versions decide which is newer (they are comparable within a resource, KEP-5504).

A watch may be half-open: its connection is alive, but nothing arrives any more. Answers to other requests show it: one has a version
that the watch does not report (Reflector.expect), or one says that an object is gone (Reflector.doubt). Then the collection is listed
again.
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

LATE = 10.0
"""Seconds within which a watch must report what another answer of the API server showed. It usually does within milliseconds, and an API
server with much to do within a few seconds. Also the least time between a list and another one because of a doubt."""


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
        self._expected = 0
        """The newest version that another answer of the API server had since that list."""
        self._listed_at = 0.0
        self._limit: asyncio.Timeout | None = None
        """When the watch under way ends because it is half-open."""
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
        before, self._expected = dict(self.items), 0
        self._listed_at = asyncio.get_running_loop().time()
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
        limit = asyncio.timeout(None)
        try:
            async with limit, contextlib.aclosing(events):  # type: ignore[type-var]
                self._limit = limit
                self._await_expected()
                async for kind, item in events:
                    version = item["metadata"]["resourceVersion"]
                    self.apply_event(kind, item)
        except TimeoutError:
            if not limit.expired():
                raise
            _logger.info("the watch of %s in %s is half-open: listing again", self._resource.plural, self._namespace)
            raise Expired from None
        finally:
            self._limit = None
        return version

    def expect(self, item: Object) -> None:
        """Have the collection listed again if the watch does not report this state of an object, or a later one, within LATE seconds after
        its last event. Objects that are not in the collection are ignored."""
        if item["metadata"].get("name") in self.items and version_of(item) > self._expected:
            self._expected = version_of(item)
            if self._limit is not None and self._limit.when() is None:
                self._await_expected()

    def doubt(self, name: str, uid: str) -> None:
        """Have the collection listed again if it has this object, which an answer of the API server says is gone.

        Nothing happens if the watch reports something first.
        """
        if self.items.get(name, {}).get("metadata", {}).get("uid") == uid:
            self._end_watch(self._listed_at + LATE)

    def _await_expected(self) -> None:
        """Limit the watch's silence if it has not reported what is expected; end the limit if it has."""
        if self._limit is not None and self._expected > self._reported:
            self._end_watch(asyncio.get_running_loop().time() + LATE)
        else:
            self._end_watch(None)

    def _end_watch(self, when: float | None) -> None:
        """End the watch under way at this moment, by the loop's clock, if it reports nothing before."""
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(when)

    def apply_event(self, kind: str, item: Object) -> None:
        """Apply an event of the watch. It is ignored if a later state of the object is known."""
        self._reported = max(self._reported, version_of(item))
        self._await_expected()
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
        self.expect(item)
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
