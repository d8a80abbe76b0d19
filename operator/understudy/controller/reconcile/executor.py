"""Carries out the writes of a plan. Each write has a guard, so that acting on outdated observations does no harm."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Apply, Create, Delete, Patch, Problem, Write
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.contention import EVERY, RepairCounts
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.kube import apply
from understudy.kube.apply import OwnedByOther
from understudy.kube.client import PODS, REPLICA_SETS, ApiError, Client, Object, Resource
from understudy.kube.gates import registry
from understudy.kube.leader_election import LeadershipLost

_logger = logging.getLogger(__name__)

MANAGER = "understudy-operator"

_MOST_NAMED = 3

RESIZE = "resize"
"""The subresource of pods for resizing them in place (KEP-1287)."""


class Stale(Exception):
    """An object has changed since it was read, so it must be observed again."""


class Contended(Exception):
    """Another client changes an object back after each repair."""


class NamespaceTerminating(Exception):
    """The namespace is being deleted, so nothing can be built in it."""


class Executor:
    """Carries out the operator's writes while this replica may write."""

    def __init__(
        self, client: Client, store: Store, expectations: Expectations, *, may_write: Callable[[], bool]
    ) -> None:
        self._client, self._store, self._expectations, self._may_write = client, store, expectations, may_write
        self._settled: dict[tuple[str, str, str], tuple[str, frozenset[str]]] = {}
        self._compared: dict[tuple[str, str, str], int] = {}
        """The version of each object that was last found to match, as a hash of UID, resourceVersion and stamp.

        Hashes save memory, because a fleet has many objects.
        """
        self._contention = RepairCounts()

    @property
    def remembered(self) -> frozenset[tuple[str, str, str]]:
        """Plural, namespace and name of the objects whose last comparison is remembered."""
        return frozenset(self._settled.keys() | self._compared.keys())

    async def run(self, key: Key, writes: Sequence[Write]) -> list[Problem]:
        """Carry out the writes, and return the permanent refusals of the API server.

        A refusal does not stop the other writes. Raises Stale, NamespaceTerminating, LeadershipLost, and the errors of a
        server that cannot answer now (ApiError that is not final, aiohttp.ClientError, TimeoutError).
        """
        problems: list[Problem] = []
        stale: ApiError | None = None
        refused_alike: set[str] = set()
        for write in writes:
            self.check()
            if (alike := _alike(write)) in refused_alike:
                continue
            try:
                await self._one(key, write)
            except OwnedByOther as taken:
                problems.append(Problem("NameTaken", str(taken)))
            except Contended as contended:
                problems.append(Problem("Contended", str(contended)))
            except ApiError as error:
                if error.status == 403 and "being terminated" in error.message:
                    raise NamespaceTerminating from error
                if error.status == 409 or (error.status == 404 and _gone(write)):
                    stale = error
                    continue
                if not error.final:
                    raise
                problems.append(refused(write, error))
                if alike is not None:
                    refused_alike.add(alike)
        if stale is not None:
            raise Stale(str(stale)) from stale
        return problems

    def forget(self, key: Key) -> None:
        """Forget the objects that belong to a deleted one.

        Objects of others with the same name prefix are forgotten too; the executor then compares them again.
        """

        def of_it(place: tuple[str, str, str]) -> bool:
            return place[1] == key.namespace and (place[2] == key.name or place[2].startswith(f"{key.name}-"))

        for known in (self._settled, self._compared):
            for place in [place for place in known if of_it(place)]:
                del known[place]
        self._contention.forget(of_it)
        self._expectations.forget(key)

    def check(self) -> None:
        """Raise LeadershipLost unless this replica may write now."""
        if not self._may_write():
            raise LeadershipLost("leadership was not renewed in time")

    async def _one(self, key: Key, write: Write) -> None:
        match write:
            case Apply(resource, body):
                await self._apply(key, resource, body)
            case Create(resource, body, counted):
                await self._create(key, resource, body, counted)
            case Patch(resource, item, body, subresource, kind):
                await self._patch(resource, item, body, subresource, kind)
            case Delete(resource, item):
                operator_metrics.WRITES.labels(resource.plural, "delete").inc()
                await apply.delete_exactly(self._client, resource, item)
                _logger.info("deleted %s %s/%s", resource.plural, key.namespace, kube_objects.name(item))

    async def _apply(self, key: Key, resource: Resource, body: Object) -> None:
        wanted = apply.stamped(body)
        place = (resource.plural, key.namespace, kube_objects.name(body))
        live = self._store.get(resource, key.namespace, kube_objects.name(body))
        if live is not None and not apply.same_controller(live, wanted):
            live = None  # the namespace was created again; establish() reads the current object
        if live is not None and self._is_so(place, live, wanted):
            return
        stamp = wanted["metadata"]["annotations"][apply.APPLIED]
        contended = live is not None and self._contention.wait(place, stamp)
        if (
            contended and resource not in registry.FENCING_RESOURCES
        ):  # a gate or an isolation policy is always repaired at once
            raise Contended(_contention_message(wanted, apply.differences(live, wanted)))
        operator_metrics.WRITES.labels(resource.plural, "apply").inc()
        try:
            if live is None:
                made = await apply.establish(self._client, resource, key.namespace, wanted, manager=MANAGER)
            else:
                made = await apply.overwrite(self._client, resource, key.namespace, wanted, live=live, manager=MANAGER)
        except ApiError as error:
            if error.conflict and live is not None:  # the stored version is outdated
                self._store.remove(resource, live)
            raise
        self._store.put(resource, made)
        # The server may normalize values (100m for 0.1). Such a difference must not be repaired again and again.
        self._settled[place] = (made["metadata"]["uid"], frozenset(apply.differences(made, wanted)))
        if live is not None:
            self._contention.written(place, stamp)
        _logger.info("applied %s %s/%s", resource.plural, key.namespace, kube_objects.name(body))
        if contended:
            raise Contended(_contention_message(wanted, apply.differences(live, wanted)))

    def _is_so(self, place: tuple[str, str, str], live: Object, wanted: Object) -> bool:
        stamp = wanted["metadata"]["annotations"][apply.APPLIED]
        if kube_objects.notes(live).get(apply.APPLIED) != stamp:
            return False
        compared = hash((kube_objects.uid(live), live["metadata"]["resourceVersion"], stamp))
        if self._compared.get(place) == compared:
            return True
        uid, settled = self._settled.get(place, ("", frozenset()))
        found = set(apply.differences(live, wanted))
        so = not (found - settled if uid == kube_objects.uid(live) else found)
        if so:
            self._compared[place] = compared
        return so

    async def _create(self, key: Key, resource: Resource, body: Object, counted: bool) -> None:
        name = kube_objects.name(body)
        pool = kube_objects.labels(body).get(names.POOL, "")
        if counted:
            self._expectations.expect(key, pool, name)
        operator_metrics.WRITES.labels(resource.plural, "create").inc()
        try:
            made = await apply.create(self._client, resource, key.namespace, body)
        except (ApiError, OwnedByOther) as error:
            if counted and (isinstance(error, OwnedByOther) or error.status < 500):
                self._expectations.settled(key, pool, name)
            raise
        self._store.put(resource, made)
        if counted:
            self._expectations.settled(key, pool, name)
        _logger.info("created %s %s/%s", resource.plural, key.namespace, name)

    async def _patch(self, resource: Resource, item: Object, body: Object, subresource: str | None, kind: str) -> None:
        metadata = item["metadata"]
        operator_metrics.WRITES.labels(resource.plural, "patch").inc()
        if subresource is None:
            guard: Object = {"uid": metadata["uid"]}
            if resource.plural != PODS.plural:  # a pod's labels do not depend on what its kubelet writes meanwhile
                guard["resourceVersion"] = metadata["resourceVersion"]
            body = {**body, "metadata": {**(body.get("metadata") or {}), **guard}}
        made = await self._client.patch(
            resource, metadata["namespace"], metadata["name"], body, kind=kind, subresource=subresource
        )
        if subresource is None:
            self._store.put(resource, made)
        _logger.info("patched %s %s/%s", resource.plural, metadata["namespace"], metadata["name"])


def _contention_message(wanted: Object, found: Sequence[str]) -> str:
    places = f" ({', '.join(path.lstrip('.') for path in found[:_MOST_NAMED])})" if found else ""
    return (
        f"{wanted['kind']} {kube_objects.name(wanted)} is changed repeatedly by another client{places}, "
        f"and repaired every {EVERY:.0f} s. "
        f"Find the other writer with kubectl get --show-managed-fields: it can be another installation of Understudy"
    )


def _alike(write: Write) -> str | None:
    """Return the pool for which a write creates one of many pods, or None for any other write.

    A refusal of one of these pods holds for the others too.
    """
    return kube_objects.labels(write.body).get(names.POOL, "") if isinstance(write, Create) and write.counted else None


def _gone(write: Write) -> bool:
    """Whether a 404 means that the object is gone.

    For a resize, an older API server may lack the subresource permanently.
    """
    return isinstance(write, Patch) and write.subresource != RESIZE


def refused(write: Write, error: ApiError) -> Problem:
    """Return the Problem for a write that the API server refuses."""
    item = write.item if isinstance(write, Patch | Delete) else write.body
    made_of_template = write.resource.plural in (PODS.plural, REPLICA_SETS.plural)
    invalid = made_of_template and (error.status in (400, 422) or error.malformed)
    reason = "TemplateInvalid" if invalid else error.reason or "Refused"
    kind, name, words = item.get("kind") or write.resource.plural, kube_objects.name(item), error.message
    if _alike(write) is not None:
        # Each attempt has another name. With the name, each attempt would change the message, and the change would
        # start a new attempt.
        stem = f"{name.rpartition('-')[0]}-*"
        name, words = stem, words.replace(name, stem)
    return Problem(reason, f"{kind} {name}: {words}")
