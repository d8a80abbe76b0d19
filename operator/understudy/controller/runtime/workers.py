"""The operator's work: watches and lists feed the store, changes become keys, and the leader's workers reconcile them."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.reconcile import change_index, operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.executor import NamespaceTerminating, Stale
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.reconcile.policy_maps import PolicyMaps
from understudy.controller.reconcile.reconciler import Reconciler
from understudy.controller.runtime import resync
from understudy.controller.runtime.work_queue import Queue
from understudy.kube import claims
from understudy.kube.client import FAILURES, PODS, POLICIES, POOLS, SECRETS, WORKLOADS, Client, Object, Resource
from understudy.kube.leader_election import LeadershipLost

_logger = logging.getLogger(__name__)

WORKERS = 8

SOON = 0.2
"""Seconds that a change waits for further changes.

A monitor makes several changes in a failover, and may share processors with the operator. After this time, the monitor
has finished.
"""

CLAIMED = {POOLS.plural: 1.0, WORKLOADS.plural: 15.0}
"""Seconds that a claim waits for the next change, by the kind of the affected object.

The next change, such as the opening of the gate, waits only for SOON. For the pool, a claim changes the numbers; for
the workload, it changes nothing. If many workloads claim at once, immediate reconciliations would delay the next
claims.
"""


class Operator:
    """One replica's watches and lists, and its workers while it leads."""

    def __init__(
        self,
        client: Client,
        store: Store,
        reconciler: Reconciler,
        *,
        namespaces: Sequence[str],
        resync_every: float,
        policy_maps: PolicyMaps | None = None,
    ) -> None:
        self._store, self._reconciler, self._policy_maps = store, reconciler, policy_maps
        if policy_maps is not None:
            policy_maps.changed = self._add
        store.noticed = self._enqueue
        if reconciler.trees is not None:
            reconciler.trees.judged = lambda key: self._add(key, 0)
        self._lists, self._resync_every = resync.ListCycle(client, store, namespaces), resync_every
        self.queue: Queue[Key] = Queue()
        self._leading = False
        self._resynced: float | None = None

    @property
    def synced(self) -> bool:
        """Whether everything was listed once."""
        return self._resynced is not None

    @property
    def stalled(self) -> bool:
        """Whether lists have failed for so long that the store cannot be trusted."""
        return self._resynced is not None and time.monotonic() - self._resynced > 10 * self._resync_every

    def see(self, resource: Resource, item: Object, gone: bool) -> None:
        """Process a watch event: store an object of Understudy, and enqueue the objects that the change affects."""
        ours = resync.kept(resource, item)
        if ours and not gone:
            self._store.put(resource, item)
        elif ours or self._store.knows(resource, item):  # nothing is remembered of other objects
            self._store.remove(resource, item)
        if not ours:
            for key in change_index.referring(resource, item, self._store):
                self._add(key)

    def _enqueue(self, change: ObservedChange) -> None:
        found = change_index.of(change, self._store)
        delays = CLAIMED if found.is_claim else {}
        for key in sorted(found.keys):
            self._add(key, delays.get(key.plural, SOON))
        if (pod := change_index.tampered(change)) is not None:
            self._add(pod)

    def _add(self, key: Key, delay: float = SOON) -> None:
        if self._leading:
            self.queue.add_after(key, delay)
            operator_metrics.WAITING.set(len(self.queue))

    async def keep_listing(self) -> None:
        """List everything periodically. Changes that only a list contains are counted and processed."""
        retry = 1.0
        while True:
            try:
                await self._list(report=self.synced)
                retry = 1.0
                await asyncio.sleep(self._resync_every)
            except FAILURES as error:
                _logger.warning("listing failed, retry in %.0f s: %s", retry, error)
                await asyncio.sleep(retry)
                retry = min(retry * 2, self._resync_every)

    async def _list(self, *, report: bool) -> None:
        started = time.time()
        for change in await self._lists.resync(gently=report):
            if report and change.resource.plural in resync.WATCHED and _aged(change, started):
                operator_metrics.MISSED.labels(change.resource.plural).inc()
        for key in change_index.unlisted(self._store):
            self._add(key)
        self._strays()
        self._resynced = time.monotonic()
        operator_metrics.RESYNCED.set_to_current_time()
        operator_metrics.RESYNC_SECONDS.set(time.time() - started)

    def _strays(self) -> None:
        """Enqueue missing workloads and pools whose label is on pods or Secrets.

        Nothing else would process these again.
        """
        for resource, label, of in (
            (PODS, names.WORKLOAD, WORKLOADS),
            (PODS, names.POOL, POOLS),
            (SECRETS, names.POOL, POOLS),
        ):
            for item in self._store.all(resource):
                labels, namespace = kube_objects.labels(item), item["metadata"]["namespace"]
                name = claims.workload_of(labels) if label == names.WORKLOAD else labels.get(label)
                if name and self._store.get(of, namespace, name) is None:
                    self._add(Key(of.plural, namespace, name))

    async def lead(self) -> None:
        """Work as the leader until cancelled. Starts with a new list, because earlier observations may be outdated.

        Raises LeadershipLost if a write is due and the lease was not renewed.
        """
        self._leading = True
        operator_metrics.LEADER.set(1)
        while True:
            try:
                await self._list(report=False)
                break
            except FAILURES as error:
                _logger.warning("listing failed: %s", error)
                await asyncio.sleep(1)
        for resource in (POLICIES, POOLS, WORKLOADS):
            for item in self._store.all(resource):
                self._add(Key(resource.plural, item["metadata"]["namespace"], kube_objects.name(item)))
        _logger.info("leading: %d objects to reconcile", len(self.queue))
        async with asyncio.TaskGroup() as group:
            for _ in range(WORKERS):
                group.create_task(self._work())
            if self._reconciler.trees is not None:
                group.create_task(self._reconciler.trees.run())
            if self._policy_maps is not None:
                group.create_task(self._policy_maps.run())

    async def _work(self) -> None:
        while True:
            key = await self.queue.take()
            operator_metrics.WAITING.set(len(self.queue))
            try:
                await self._one(key)
            finally:
                self.queue.done(key)

    async def _one(self, key: Key) -> None:
        result = "ok"
        try:
            with operator_metrics.SECONDS.labels(key.plural).time():
                again = await self._reconciler.reconcile(key)
            self.queue.succeeded(key)
            if again is not None:
                self.queue.add_after(key, again)
        except LeadershipLost:
            raise
        except NamespaceTerminating:
            result = "ending"
            _logger.info("%s %s/%s: the namespace is being deleted", *key)
        except Stale as stale:
            result = "stale"
            delay = self.queue.retry(key)
            _logger.info("%s %s/%s: %s; retry in %.1f s", *key, stale, delay)
        except FAILURES as error:
            result = "unreachable"
            delay = self.queue.retry(key)
            _logger.warning("%s %s/%s: %s; retry in %.1f s", *key, error or type(error).__name__, delay)
        except Exception:  # an unexpected error for one object must not end the protection of all others
            result = "error"
            delay = self.queue.retry(key)
            _logger.exception("%s %s/%s failed; retry in %.1f s", *key, delay)
        operator_metrics.RECONCILED.labels(key.plural, result).inc()


def _aged(change: ObservedChange, started: float) -> bool:
    """Whether a watch had enough time to report the change: a list may simply have been faster."""
    return change.new is None or started - kube_objects.created(change.new) > 5
