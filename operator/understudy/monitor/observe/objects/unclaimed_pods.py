"""The unclaimed pods of a shared pool.

Monitors do not watch them all the time: each claim, and each change of the replacement pod, would be sent to every monitor of a
fleet, though hardly any of them ever needs such a pod. A monitor that needs one lists them, and watches only while it waits.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Mapping

from understudy.api import names
from understudy.kube import pod_tables
from understudy.kube.client import PODS, Client, Object
from understudy.kube.repeated_requests import answered
from understudy.kube.watched_collection import Reflector

RUNNING = "status.phase=Running"
"""Pods that are still starting cannot be claimed, so the watch leaves them out."""


class Unclaimed:
    """The unclaimed pods of one pool, by name."""

    def __init__(self, client: Client, namespace: str, pool: str) -> None:
        self._client, self._namespace = client, namespace
        self._labels = {names.HELD: "true", names.POOL: pool, names.CLAIMED_BY: names.UNCLAIMED}
        labels = _selector(self._labels)
        self._watched = Reflector(client, PODS, namespace, labels=labels, fields=RUNNING, cached=True)
        self._found: dict[str, Object] = {}

    @property
    def items(self) -> Mapping[str, Object]:
        """The pods of the last list, or those of the watch while one runs."""
        return self._watched.items if self._watched.synced.is_set() else self._found

    async def refresh(self, part: str = "", template_hash: str = "") -> None:
        """List the pods: all or one part of them (claims.part), of any template or one. Waits while the API server does not
        answer. Raises ApiError.
        """
        labels = self._labels | ({names.PART: part} if part else {})
        labels |= {names.TEMPLATE_HASH: template_hash} if template_hash else {}
        answer = await answered(
            lambda: self._client.table(PODS, self._namespace, labels=_selector(labels), fields=RUNNING),
            within=None,
        )
        pods = pod_tables.pods(answer, namespace=self._namespace, labels=labels)
        self._found = {pod["metadata"]["name"]: pod for pod in pods}

    @contextlib.asynccontextmanager
    async def followed(self) -> AsyncIterator[None]:
        """Watch all unclaimed pods of the pool while the context is open."""
        watching = asyncio.create_task(self._watched.run())
        try:
            yield
        finally:
            self._found = dict(self.items)
            self._watched.synced.clear()
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    def changed(self) -> Awaitable[object]:
        """Return an awaitable that completes when the watch reports a change."""
        return self._watched.changed()


def _selector(labels: Mapping[str, str]) -> str:
    return ",".join(f"{key}={value}" for key, value in labels.items())
