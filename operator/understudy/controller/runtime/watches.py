"""Watches all kinds except Understudy's own, so that the operator acts on a change within moments.

kopf watches Understudy's own kinds. It could watch the others too, but it keeps a record of each object, and a task and
a queue for each event. With a fleet's objects that exceeds the operator's memory bound:
docs/explanation/operator-events.md has the figures.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence

from understudy.controller.runtime.kopf_handlers import See
from understudy.controller.runtime.resync import TREES
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    FAILURES,
    NODES,
    PODS,
    REPLICA_SETS,
    SERVICES,
    STATEFUL_SETS,
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
"""Watched resources with their label selectors. A RobotWorkload may refer to any controller, and so to its pods."""

BEGINNING = "0"
"""The resourceVersion at which a watch first sends all existing objects."""


async def watch(client: Client, see: See, namespaces: Sequence[str]) -> None:
    """Watch until cancelled, in the given namespaces or in all. Errors are retried."""
    async with asyncio.TaskGroup() as group:
        for resource, labels in WATCHED:
            for namespace in (namespaces if resource != NODES else ()) or (None,):
                group.create_task(_keep(client, see, resource, labels, namespace))


async def _keep(client: Client, see: See, resource: Resource, labels: str | None, namespace: str | None) -> None:
    version, retry = BEGINNING, RETRY_FIRST
    while True:
        events = client.watch(resource, namespace, version=version, labels=labels)
        try:
            async with contextlib.aclosing(events):  # type: ignore[type-var]
                async for kind, item in events:
                    retry = RETRY_FIRST
                    if kind != "BOOKMARK":
                        _hand_on(see, resource, item, kind == "DELETED")
                    # Existing objects come in any order, so no version covers all before it until the first bookmark.
                    if kind == "BOOKMARK" or version != BEGINNING:
                        version = item["metadata"]["resourceVersion"]
        except Expired:  # the next list finds what was deleted meanwhile
            version = BEGINNING
        except FAILURES as error:
            level = logging.DEBUG if retry < RETRY_MOST else logging.WARNING
            _logger.log(level, "watching %s: %s", resource.plural, error or type(error).__name__)
            await client.contact.pause(retry)
            retry = min(retry * 2, RETRY_MOST)


def _hand_on(see: See, resource: Resource, item: Object, gone: bool) -> None:
    try:
        see(resource, item, gone)
    except Exception:  # an unexpected object must not end the protection of all others
        _logger.exception("%s %s", resource.plural, item["metadata"].get("name"))
