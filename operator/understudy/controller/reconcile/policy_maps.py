"""Compares what the gates need with the room in Cilium's policy maps, so that users are warned before the network falls open.

The operator looks every few minutes, and sooner if there are more pods. It counts the same identities as ``understudy doctor``, and not the
pods that it watches: pods of others are peers too, and identities of deleted pods count for a while. In a cluster with another network, a
look is one request that is answered with 404.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Protocol

from understudy.controller.observed import kube_objects
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import Store
from understudy.controller.status import policy_map_room
from understudy.kube.client import (
    CONFIG_MAPS,
    FAILURES,
    NETWORK_POLICIES,
    PODS,
    WORKLOADS,
    ApiError,
    Object,
    Part,
    Resource,
)
from understudy.kube.gates import cilium, registry
from understudy.kube.gates.cilium import PolicyMapUse, Settings
from understudy.kube.gates.policy_entries import Peer, Peers

_logger = logging.getLogger(__name__)

EVERY = 300.0
"""Seconds between two looks."""

SOONEST = 30.0
"""Seconds after which the operator looks again if there are more pods than at the last look."""


class Reader(Protocol):
    """Reads Cilium's objects. :class:`understudy.kube.client.Client` implements it."""

    async def find(self, resource: Resource, namespace: str | None, name: str) -> Object | None:
        """Return an object, or None if it does not exist."""

    def parts(self, resource: Resource, namespace: str | None = None) -> AsyncIterator[Part]:
        """Yield a collection in parts."""


class PolicyMaps:
    """What each gate in the network needs of the policy maps, as of the last look."""

    def __init__(self, client: Reader, store: Store) -> None:
        self._client, self._store = client, store
        self._low: dict[Key, PolicyMapUse] = {}
        self.known = False
        """Whether the operator has looked."""
        self.changed: Callable[[Key], None] = lambda key: None
        """Called with each workload of which something else is to be reported."""

    def low(self, namespace: str, name: str) -> PolicyMapUse | None:
        """Return what a workload needs; None if there is enough room, if the network is not Cilium, or before the first look."""
        return self._low.get(Key(WORKLOADS.plural, namespace, name))

    async def run(self) -> None:
        """Look until cancelled."""
        counted, due = 0, 0.0
        while True:
            pods, now = len(self._store.all(PODS)), time.monotonic()
            if now >= due or pods > counted:
                counted, due = pods, now + EVERY
                await self._look()
            await asyncio.sleep(SOONEST)

    async def _look(self) -> None:
        try:
            await self.refresh()
        except FAILURES as error:
            why = error or type(error).__name__
            _logger.warning("cannot read how much room Cilium's policy maps have: %s", why)
        except Exception:  # an unexpected object must not end the protection of all workloads
            _logger.exception("cannot compute how much room Cilium's policy maps have")

    async def refresh(self) -> None:
        """Look once. Raises what a request raises; the last result then stays."""
        uses = await self._uses()
        operator_metrics.policy_maps({(key.namespace, key.name): use.share for key, use in uses.items()})
        before, self._low = self._low, {key: use for key, use in uses.items() if use.is_low}
        changed = {
            key
            for key in before.keys() | self._low.keys()
            if _reported(before.get(key)) != _reported(self._low.get(key))
        }
        if not self.known:
            self.known = True
            changed |= {_key(one) for one in self._store.all(WORKLOADS) if policy_map_room.is_reported(one)}
        for key in sorted(changed):
            self.changed(key)

    async def _uses(self) -> dict[Key, PolicyMapUse]:
        """Return what each gate needs; nothing if the network is not Cilium, or if the operator may not see its identities."""
        workloads = self._store.all(WORKLOADS)
        gated = [one for one in workloads if not registry.of(one).is_at_robot and not kube_objects.deleted(one)]
        peers = await self._peers() if gated else []
        if not peers:
            return {}
        settings, everybody = await self._settings(), Peers(peers)
        policies: dict[str, Mapping[str, Object]] = {}
        found = {}
        for workload in gated:
            name, namespace = kube_objects.name(workload), workload["metadata"]["namespace"]
            if namespace not in policies:
                policies[namespace] = self._store.in_namespace(NETWORK_POLICIES, namespace)
            # Among a thousand peers, it takes some milliseconds for each workload. Others run meanwhile.
            use = await asyncio.to_thread(
                cilium.policy_map_use, name, namespace, policies[namespace], everybody, settings
            )
            if use is not None:
                found[_key(workload)] = use
        return found

    async def _peers(self) -> list[Peer]:
        found: list[Peer] = []
        try:
            async for part in self._client.parts(cilium.IDENTITIES):
                found += await asyncio.to_thread(_peers_of, part)
        except ApiError as error:
            if error.final and error.status in (403, 404):
                return []
            raise
        return found

    async def _settings(self) -> Settings:
        """Return Cilium's settings; the defaults if they cannot be read, which is reported then."""
        try:
            found = await self._client.find(CONFIG_MAPS, cilium.SYSTEM, cilium.SETTINGS)
        except ApiError as error:
            if error.final and error.status == 403:
                return cilium.UNREADABLE
            raise
        return Settings.of(found.get("data") or {}) if found is not None else cilium.UNREADABLE


def _key(workload: Object) -> Key:
    return Key(WORKLOADS.plural, workload["metadata"]["namespace"], kube_objects.name(workload))


def _peers_of(part: Part) -> list[Peer]:
    return [cilium.peer(one) for one in part.items()]


def _reported(use: PolicyMapUse | None) -> tuple[int, int, Settings] | None:
    """Return what a condition contains of a use: whole percents, so that it is not written again for each pod."""
    return (use.percent, use.each, use.settings) if use is not None else None
