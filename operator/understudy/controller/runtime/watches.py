"""Watches everything but our own kinds, so that what changes is acted on within moments.

kopf could, and does for our own. But it has a record of each object that it watches, and a task, a queue and the whole text of each that
comes: with a fleet's pods, sets and policies that is several times what the store keeps of them. And it would bring every ConfigMap
of the cluster, since it selects by labels only what has already been sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence

import aiohttp

from understudy.controller.runtime.kopf_handlers import See
from understudy.controller.runtime.resync import TREES
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    NODES,
    PODS,
    REPLICA_SETS,
    SERVICES,
    STATEFUL_SETS,
    ApiError,
    Client,
    Expired,
    Object,
    Resource,
)
from understudy.kube.gates import registry
from understudy.kube.watched_collection import RETRY_FIRST, RETRY_MOST

_logger = logging.getLogger(__name__)

WATCHED: tuple[tuple[Resource, str | None], ...] = (
    (PODS, None),
    (REPLICA_SETS, None),
    (DEPLOYMENTS, None),
    (STATEFUL_SETS, None),
    *((resource, None) for resource in registry.FENCING_RESOURCES),
    (SERVICES, None),
    (DISRUPTION_BUDGETS, None),
    (NODES, None),
    (CONFIG_MAPS, TREES),
)
"""What is watched, and by which label selector. Workloads may refer to anybody's controllers, and so to their pods."""

BEGINNING = "0"
"""The version from which a watch first brings what is there."""

SILENCE = 75.0
"""Seconds after which a watch that brings not even a bookmark, of which there is one a minute, is begun anew."""


async def watch(client: Client, see: See, namespaces: Sequence[str]) -> None:
    """Watch until cancelled, in the given namespaces or in all, through every error."""
    async with asyncio.TaskGroup() as group:
        for resource, labels in WATCHED:
            for namespace in (namespaces if resource != NODES else ()) or (None,):
                group.create_task(_keep(client, see, resource, labels, namespace))


async def _keep(client: Client, see: See, resource: Resource, labels: str | None, namespace: str | None) -> None:
    version, retry = BEGINNING, RETRY_FIRST
    while True:
        events = client.watch(resource, namespace, version=version, labels=labels, silence=SILENCE)
        try:
            async with contextlib.aclosing(events):  # type: ignore[type-var]
                async for kind, item in events:
                    retry = RETRY_FIRST
                    if kind != "BOOKMARK":
                        _tell(see, resource, item, kind == "DELETED")
                    # What is there already comes in any order: until a bookmark, no version stands for all before it.
                    if kind == "BOOKMARK" or version != BEGINNING:
                        version = item["metadata"]["resourceVersion"]
        except Expired:  # of what is gone meanwhile the next list tells
            version = BEGINNING
        except (ApiError, aiohttp.ClientError, TimeoutError, OSError) as error:
            level = logging.DEBUG if retry < RETRY_MOST else logging.WARNING
            _logger.log(level, "watching %s: %s", resource.plural, error or type(error).__name__)
            await asyncio.sleep(retry)
            retry = min(retry * 2, RETRY_MOST)


def _tell(see: See, resource: Resource, item: Object, gone: bool) -> None:
    try:
        see(resource, item, gone)
    except Exception:  # one object's surprise must not end the protection of all others
        _logger.exception("%s %s", resource.plural, item["metadata"].get("name"))
