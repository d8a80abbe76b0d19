"""Lists everything periodically, which finds and reports the changes that a watch missed.

kopf's watches can fall silent without an error. So watches only make the operator fast; its correctness does not depend
on them.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
import itertools
import logging
import time
from collections.abc import AsyncIterator, Iterator, Sequence

from understudy.api import names
from understudy.controller.observed import health_tree_sources, kube_objects, ownership
from understudy.controller.reconcile.object_store import ObservedChange, Store, same, slim
from understudy.controller.reconcile.object_store import version as version_of
from understudy.kube import apply
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    DISRUPTION_BUDGETS,
    NODES,
    PODS,
    POLICIES,
    POOLS,
    REPLICA_SETS,
    ROLE_BINDINGS,
    ROLES,
    SECRETS,
    SERVICE_ACCOUNTS,
    SERVICES,
    WORKLOADS,
    ApiError,
    Client,
    Object,
    Part,
    Resource,
)
from understudy.kube.gates import registry

_logger = logging.getLogger(__name__)

Parts = dict[bytes, list[Object]]
"""The objects of a list's parts, by a digest of their text."""

REST, REST_MOST = 4.0, 0.25
"""The pause after each part of a list that is not urgent: a multiple of the part's duration, and a maximum in seconds.

The lists of a fleet of 1000 robots are 86 MB. While the API server sends them as fast as it can, other clients wait.
"""

LONG_TURN = 0.02
"""Processor time in seconds after which the decoding of a part lets others run. A part may have many objects of a megabyte."""

PATIENCE, QUIET = 30.0, 0.5
"""Maximum total wait of such a list while watches report changes, and the quiet time that ends a wait; in seconds.

Watches that report changes are not silent. In a burst of failures, the clients that make the changes wait for the API
server too.
"""

TREES = f"{names.HEALTH_TREE}=true"
"""Selects the ConfigMaps that policies may read."""

_OURS = ",".join(f"{key}={value}" for key, value in kube_objects.MANAGED_BY.items())

LISTED: tuple[tuple[Resource, tuple[str | None, ...]], ...] = (
    (WORKLOADS, (None,)),
    (POLICIES, (None,)),
    (POOLS, (None,)),
    (PODS, (names.COMPONENT, f"{names.WORKLOAD},!{names.COMPONENT}")),
    (REPLICA_SETS, (_OURS,)),
    (DEPLOYMENTS, (_OURS,)),
    (SERVICES, (_OURS,)),
    *((resource, (_OURS,)) for resource in registry.FENCING_RESOURCES),
    (DISRUPTION_BUDGETS, (None,)),
    (NODES, (None,)),
    (CONFIG_MAPS, (_OURS, TREES)),
    (SECRETS, (_OURS,)),
    (SERVICE_ACCOUNTS, (_OURS,)),
    (ROLES, (_OURS,)),
    (ROLE_BINDINGS, (_OURS,)),
)
"""Resources that the store keeps, and the label selectors for listing them."""

WATCHED = frozenset(resource.plural for resource, _ in LISTED) - frozenset(
    resource.plural for resource in (CONFIG_MAPS, SECRETS, SERVICE_ACCOUNTS, ROLES, ROLE_BINDINGS)
)
"""Resources for which a list should contain nothing new."""


_WHOLLY = frozenset(resource.plural for resource, selectors in LISTED if selectors == (None,))
"""Resources of which all objects are kept. A budget of another owner limits what may be done with a pod."""


def listed(resource: Resource, item: Object) -> bool:
    """Whether an object is one of those that are listed."""
    labels = kube_objects.labels(item)
    if resource.plural in _WHOLLY:
        return True
    if resource.plural == PODS.plural:
        return names.COMPONENT in labels or names.WORKLOAD in labels
    if resource.plural == CONFIG_MAPS.plural and health_tree_sources.lent(item):
        return True
    return all(labels.get(key) == value for key, value in kube_objects.MANAGED_BY.items())


def kept(resource: Resource, item: Object) -> bool:
    """Whether an object from a watch is kept. This includes an object of Understudy whose labels were removed."""
    if listed(resource, item) or ownership.is_understudys(item):
        return True
    return resource.plural == PODS.plural and bool(apply.released(item))


async def _items(part: Part) -> AsyncIterator[Object]:
    """Yield the objects of a part. Another thread decodes them, and others run meanwhile."""
    items = part.items()
    while some := await asyncio.to_thread(_next, items):
        for item in some:
            yield item


def _next(items: Iterator[Object]) -> list[Object]:
    """Return the next objects, as many as are decoded in a short time."""
    found, end = [], time.thread_time() + LONG_TURN
    for item in items:
        found.append(item)
        if time.thread_time() >= end:
            break
    return found


class ListCycle:
    """Lists everything into a store, periodically.

    Most parts of a fleet's lists are the same as before, byte for byte. Decoding is nearly all of the work, so they are
    not decoded: their known objects are stored again.
    """

    def __init__(self, client: Client, store: Store, namespaces: Sequence[str]) -> None:
        """Create lists for the given namespaces, or for all."""
        self._client, self._store, self._namespaces = client, store, namespaces
        self._known: dict[tuple[str, str | None], Parts] = {}
        self._patience = 0.0

    async def resync(self, *, gently: bool = False) -> list[ObservedChange]:
        """List everything, and return the changes. ``gently`` adds pauses, if nothing waits for the result.

        Raises ApiError, aiohttp.ClientError or TimeoutError. Objects that were listed before the error are stored.
        """
        changes: list[ObservedChange] = []
        self._patience = PATIENCE
        for resource, selectors in LISTED:
            for namespace in (self._namespaces if resource != NODES else ()) or (None,):
                changes += await self._list(resource, namespace, selectors, gently=gently)
        return changes

    async def _list(
        self, resource: Resource, namespace: str | None, selectors: Sequence[str | None], *, gently: bool
    ) -> list[ObservedChange]:
        place = (resource.plural, namespace)
        known, found = self._known.get(place, {}), Parts()
        # The version of the first list: an object that was created between two lists is newer, and is kept.
        version: int | None = None
        for selector in selectors:
            started = time.monotonic()
            async for part in self._client.parts(resource, namespace, labels=selector):
                version = int(part.head["metadata"]["resourceVersion"]) if version is None else version
                digest = hashlib.blake2b(part.body, digest_size=16).digest()
                found[digest] = known.get(digest) or [slim(resource, item) async for item in _items(part)]
                if gently:
                    await self._yield_to_others(time.monotonic() - started)
                    started = time.monotonic()
        assert version is not None, "every list has a part"
        covered = functools.partial(listed, resource)
        changes = self._store.replace(resource, itertools.chain(*found.values()), version, namespace, covered=covered)
        self._known[place] = {digest: self._stored(resource, items) for digest, items in found.items()}
        for item in self._store.all(resource):
            mine = namespace is None or item["metadata"].get("namespace", "") == namespace
            if mine and kept(resource, item) and not covered(item):
                changes += await self._ask(resource, item)
        return changes

    async def _ask(self, resource: Resource, item: Object) -> list[ObservedChange]:
        """Ask for an object that no list contains, because somebody has removed its labels: its watch may have missed its end."""
        metadata = item["metadata"]
        try:
            found = await self._client.get(resource, metadata.get("namespace"), metadata["name"])
        except ApiError as error:
            if not error.not_found:
                raise
            change = self._store.remove(resource, item)
        else:
            change = self._store.put(resource, found)
        return [change] if change is not None else []

    async def _yield_to_others(self, took: float) -> None:
        """Give way to other clients after a part that took ``took`` seconds."""
        await asyncio.sleep(min(REST_MOST, REST * took))
        while self._patience > 0 and self._store.quiet < QUIET:
            await asyncio.sleep(QUIET)
            self._patience -= QUIET

    def _stored(self, resource: Resource, items: Sequence[Object]) -> list[Object]:
        """Return the objects as they are in the store, so that they are not kept twice.

        Returns an empty list if the store lacks one of them or has another version of it.
        """
        stored = []
        for item in items:
            there = self._store.get(resource, item["metadata"].get("namespace", ""), item["metadata"]["name"])
            if there is None or version_of(there) != version_of(item) or not same(there, item):
                return []
            stored.append(there)
        return stored
