"""Lists everything once in a while: what a watch has missed is found then, and told.

kopf's watches can fall silent without an error, so they are only a way to be quick, never what correctness rests on.
"""

from __future__ import annotations

import asyncio
import functools
import hashlib
import itertools
import logging
import time
from collections.abc import Sequence

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.observed import health_tree_sources, kube_objects
from understudy.controller.reconcile.object_store import Sight, Store, same, slim
from understudy.controller.reconcile.object_store import version as version_of
from understudy.kube.apply import controller_of
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
    Client,
    Object,
    Resource,
)
from understudy.kube.gates import registry

_logger = logging.getLogger(__name__)

Parts = dict[bytes, list[Object]]
"""What the parts of a list were, by a digest of their text."""

REST, REST_MOST = 4.0, 0.25
"""How long a list that isn't urgent rests after each part: so many times what the part took, and so many seconds at most. A fleet of
1000 robots is 86 MB, and while the API server writes it as fast as it can, others wait.
"""

PATIENCE, QUIET = 30.0, 0.5
"""Seconds that such a list stands back in all while watches bring something, and after which they bring nothing. As long as they do they
aren't silent, and those who make the changes, in a burst of failures, wait for the API server too.
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
"""What is kept, and by which label selectors it is found."""

WATCHED = frozenset(
    r.plural
    for r in (
        WORKLOADS,
        POLICIES,
        POOLS,
        PODS,
        REPLICA_SETS,
        DEPLOYMENTS,
        SERVICES,
        *registry.FENCING_RESOURCES,
        DISRUPTION_BUDGETS,
        NODES,
    )
)
"""Of these a list should bring nothing new."""


_WHOLLY = frozenset(r.plural for r in (WORKLOADS, POLICIES, POOLS, DISRUPTION_BUDGETS, NODES))
"""Of these all are kept: a budget of somebody else's matters to what may be done with a pod."""


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
    """Whether an object that a watch brought means something: also one of ours whose label somebody took off."""
    owner = controller_of(item)
    return listed(resource, item) or (owner is not None and owner.get("apiVersion") == API_VERSION)


class Lists:
    """Lists everything into a store, again and again.

    Most parts of a fleet's lists are the same again, byte for byte. They aren't decoded, which is nearly all of the work: what they
    were is taken in once more.
    """

    def __init__(self, client: Client, store: Store, namespaces: Sequence[str]) -> None:
        """In the given namespaces, or in all."""
        self._client, self._store, self._namespaces = client, store, namespaces
        self._known: dict[tuple[str, str | None], Parts] = {}
        self._patience = 0.0

    async def resync(self, *, gently: bool = False) -> list[Sight]:
        """List everything; what that changed. ``gently``, with rests, where nothing waits for it.

        Raises ApiError, aiohttp.ClientError or TimeoutError; what was listed before counts.
        """
        sights: list[Sight] = []
        self._patience = PATIENCE
        for resource, selectors in LISTED:
            for namespace in (self._namespaces if resource != NODES else ()) or (None,):
                sights += await self._list(resource, namespace, selectors, gently=gently)
        return sights

    async def _list(
        self, resource: Resource, namespace: str | None, selectors: Sequence[str | None], *, gently: bool
    ) -> list[Sight]:
        place = (resource.plural, namespace)
        known, found = self._known.get(place, {}), Parts()
        # the first list's version: what was made between two lists is newer and stays
        version: int | None = None
        for selector in selectors:
            begun = time.monotonic()
            async for part in self._client.parts(resource, namespace, labels=selector):
                version = int(part.head["metadata"]["resourceVersion"]) if version is None else version
                digest = hashlib.blake2b(part.body, digest_size=16).digest()
                found[digest] = known.get(digest) or [slim(resource, item) for item in part.items()]
                if gently:
                    await self._stand_back(time.monotonic() - begun)
                    begun = time.monotonic()
        assert version is not None, "every list has a part"
        covered = functools.partial(listed, resource)
        sights = self._store.replace(resource, itertools.chain(*found.values()), version, namespace, covered=covered)
        self._known[place] = {digest: self._stored(resource, items) for digest, items in found.items()}
        return sights

    async def _stand_back(self, took: float) -> None:
        """Let others go first after a part that took so many seconds."""
        await asyncio.sleep(min(REST_MOST, REST * took))
        while self._patience > 0 and self._store.quiet < QUIET:
            await asyncio.sleep(QUIET)
            self._patience -= QUIET

    def _stored(self, resource: Resource, items: Sequence[Object]) -> list[Object]:
        """The objects as the store has them, so that they aren't kept twice; none where it has another, or none."""
        stored = []
        for item in items:
            there = self._store.get(resource, item["metadata"].get("namespace", ""), item["metadata"]["name"])
            if there is None or version_of(there) != version_of(item) or not same(there, item):
                return []
            stored.append(there)
        return stored
