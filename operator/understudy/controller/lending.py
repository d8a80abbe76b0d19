"""Watches the ConfigMaps that policies may read, so that a changed health tree is in force within moments.

kopf would bring every ConfigMap of the cluster: it selects by labels only what has already been sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence

import aiohttp

from understudy.cluster.client import CONFIG_MAPS, ApiError, Client, Expired, Object, Resource
from understudy.controller.resyncing import TREES

_logger = logging.getLogger(__name__)

RETRY = 5.0  # seconds; what is missed meanwhile the next list of everything brings

See = Callable[[Resource, Object, bool], None]


async def watch(client: Client, see: See, namespaces: Sequence[str]) -> None:
    """Watch until cancelled, in the given namespaces or in all, through every error."""
    async with asyncio.TaskGroup() as group:
        for namespace in namespaces or (None,):
            group.create_task(_keep(client, see, namespace))


async def _keep(client: Client, see: See, namespace: str | None) -> None:
    while True:
        try:
            await _follow(client, see, namespace)
        except Expired:
            continue
        except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            _logger.debug("watching the health trees in ConfigMaps: %s", error)
            await asyncio.sleep(RETRY)


async def _follow(client: Client, see: See, namespace: str | None) -> None:
    answer = await client.list(CONFIG_MAPS, namespace, labels=TREES)
    for item in answer.get("items") or []:
        see(CONFIG_MAPS, {"apiVersion": "v1", "kind": "ConfigMap", **item}, False)
    version: str = answer["metadata"]["resourceVersion"]
    while True:
        events = client.watch(CONFIG_MAPS, namespace, version=version, labels=TREES)
        async with contextlib.aclosing(events):  # type: ignore[type-var]
            async for kind, item in events:
                version = item["metadata"]["resourceVersion"]
                if kind != "BOOKMARK":
                    see(CONFIG_MAPS, item, kind == "DELETED")
