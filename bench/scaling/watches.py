"""A shared copy of what all monitors of a fleet watch: each has its own watch, but only one is decoded.

In a real fleet each monitor decodes its watch on its own machine. Here the monitors share some processors with the API
server, whose cost for all these watches is measured.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Mapping

import aiohttp

from understudy.kube.client import Client, Object, Resource
from understudy.kube.watched_collection import RETRY_FIRST, Reflector

LIFETIME = 300
"""Seconds of one watch, as in the monitor."""


class Drain(Client):
    """A client that can hold a watch open without decoding its events."""

    async def drain(self, resource: Resource, namespace: str, selector: Mapping[str, str], version: str) -> None:
        """Receive data until the server ends the watch."""
        assert self._session is not None
        params = {
            **selector,
            "watch": "true",
            "resourceVersion": version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": str(LIFETIME),
        }
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=10, sock_read=LIFETIME + 15)
        url = self._access.server + resource.path(namespace)
        async with self._session.get(url, params=params, headers=await self._headers(), timeout=timeout) as response:
            response.raise_for_status()
            async for _ in response.content.iter_any():
                pass


class Borrowed(Reflector):
    """Another reflector's copy, with a watch of its own whose events are not decoded."""

    def __init__(
        self, original: Reflector, client: Drain, resource: Resource, namespace: str, *, labels: str | None = None
    ) -> None:
        self._original, self._drain = original, client
        self._of, self._in = resource, namespace
        self._selector = {"labelSelector": labels} if labels else {}
        self.synced = original.synced

    @property
    def items(self) -> dict[str, Object]:  # type: ignore[override]
        """The objects of the original."""
        return self._original.items

    @property
    def revision(self) -> int:  # type: ignore[override]
        """The revision of the original."""
        return self._original.revision

    async def run(self) -> None:
        """Watch until cancelled, and continue after every error."""
        await self.synced.wait()
        while True:
            try:
                await self._drain.drain(self._of, self._in, self._selector, str(self._original._reported))
            except (aiohttp.ClientError, TimeoutError, OSError):
                await asyncio.sleep(RETRY_FIRST)

    def put(self, item: Object) -> None:
        """Do nothing: nobody writes these objects."""

    def changed(self) -> Awaitable[object]:
        """Return an awaitable that ends with the next change."""
        return self._original.changed()
