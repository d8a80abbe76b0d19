"""Carries out the writes of a plan, each guarded so that acting on an old sight does no harm."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Apply, Create, Delete, Patch, Problem, Write
from understudy.controller.reconcile import operator_metrics
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.contention import EVERY, Contention
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import Store
from understudy.kube import apply
from understudy.kube.apply import Taken
from understudy.kube.client import PODS, REPLICA_SETS, ApiError, Client, Object, Resource
from understudy.kube.gates import registry
from understudy.kube.leader_election import LeadershipLost

_logger = logging.getLogger(__name__)

MANAGER = "understudy-operator"

_MOST_NAMED = 3

RESIZE = "resize"
"""The subresource of pods by which they are resized in place (KEP-1287)."""


class Stale(Exception):
    """Something has changed since it was read: look again."""


class Contended(Exception):
    """Somebody else changes an object back each time that it is put right."""


class Ending(Exception):
    """The namespace is being deleted: there is nothing to build any more."""


class Executor:
    """Makes writes of one operator, while it may."""

    def __init__(
        self, client: Client, store: Store, expectations: Expectations, *, may_write: Callable[[], bool]
    ) -> None:
        self._client, self._store, self._expectations, self._may_write = client, store, expectations, may_write
        self._settled: dict[tuple[str, str, str], tuple[str, frozenset[str]]] = {}
        self._compared: dict[tuple[str, str, str], int] = {}
        """Which version of an object was found to be as wanted, and as what: hashes, since a fleet has many objects."""
        self._contention = Contention()

    async def run(self, key: Key, writes: Sequence[Write]) -> list[Problem]:
        """Make the writes; what the API server refuses for good is returned, and the others are still made.

        Raises Stale, Ending, LeadershipLost, and what a server that can't answer now raises (ApiError 429 and 5xx,
        aiohttp.ClientError, TimeoutError).
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
            except Taken as taken:
                problems.append(Problem("NameTaken", str(taken)))
            except Contended as contended:
                problems.append(Problem("Contended", str(contended)))
            except ApiError as error:
                if error.status == 403 and "being terminated" in error.message:
                    raise Ending from error
                if error.status == 409 or (error.status == 404 and _gone(write)):
                    stale = error
                    continue
                if error.passing:
                    raise
                problems.append(refused(write, error))
                if alike is not None:
                    refused_alike.add(alike)
        if stale is not None:
            raise Stale(str(stale)) from stale
        return problems

    def forget(self, key: Key) -> None:
        """Forget what is known of the objects of one that is gone. Of others whose names begin alike it is found out again."""

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
            raise LeadershipLost("the lease was not renewed in time")

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
            live = None  # a namespace that was made anew has the same names: establish() looks at what is there now
        if live is not None and self._is_so(place, live, wanted):
            return
        stamp = wanted["metadata"]["annotations"][apply.APPLIED]
        contended = live is not None and self._contention.wait(place, stamp)
        if (
            contended and resource not in registry.FENCING_RESOURCES
        ):  # what keeps standbys from the robot is never left as it is
            raise Contended(_told(wanted, apply.differences(live, wanted)))
        operator_metrics.WRITES.labels(resource.plural, "apply").inc()
        try:
            if live is None:
                made = await apply.establish(self._client, resource, key.namespace, wanted, manager=MANAGER)
            else:
                made = await apply.overwrite(self._client, resource, key.namespace, wanted, live=live, manager=MANAGER)
        except ApiError as error:
            if error.conflict and live is not None:  # what was known of it isn't so any more
                self._store.remove(resource, live)
            raise
        self._store.put(resource, made)
        # what the server wrote differently (100m for 0.1) isn't a difference to be repaired for ever
        self._settled[place] = (made["metadata"]["uid"], frozenset(apply.differences(made, wanted)))
        if live is not None:
            self._contention.written(place, stamp)
        _logger.info("applied %s %s/%s", resource.plural, key.namespace, kube_objects.name(body))
        if contended:
            raise Contended(_told(wanted, apply.differences(live, wanted)))

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
        except (ApiError, Taken) as error:
            if counted and (isinstance(error, Taken) or error.status < 500):
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
            if resource.plural != PODS.plural:  # labels of a pod don't depend on what its kubelet writes meanwhile
                guard["resourceVersion"] = metadata["resourceVersion"]
            body = {**body, "metadata": {**(body.get("metadata") or {}), **guard}}
        made = await self._client.patch(
            resource, metadata["namespace"], metadata["name"], body, kind=kind, subresource=subresource
        )
        if subresource is None:
            self._store.put(resource, made)
        _logger.info("patched %s %s/%s", resource.plural, metadata["namespace"], metadata["name"])


def _told(wanted: Object, found: Sequence[str]) -> str:
    places = f" ({', '.join(path.lstrip('.') for path in found[:_MOST_NAMED])})" if found else ""
    return (
        f"{wanted['kind']} {kube_objects.name(wanted)} is changed repeatedly by another client{places}, "
        f"and repaired every {EVERY:.0f} s. "
        f"Find the other writer with kubectl get --show-managed-fields: it can be another installation of Understudy"
    )


def _alike(write: Write) -> str | None:
    """The pool of which a write makes one of many pods: what is said of one holds for the others too. None for any other write."""
    return kube_objects.labels(write.body).get(names.POOL, "") if isinstance(write, Create) and write.counted else None


def _gone(write: Write) -> bool:
    """Whether what isn't found is the object: an older API server may lack the subresource, for good."""
    return isinstance(write, Patch) and write.subresource != RESIZE


def refused(write: Write, error: ApiError) -> Problem:
    """What the API server says of a write that it won't take."""
    item = write.item if isinstance(write, Patch | Delete) else write.body
    made_of_template = write.resource.plural in (PODS.plural, REPLICA_SETS.plural)
    invalid = made_of_template and (error.status in (400, 422) or error.malformed)
    reason = "TemplateInvalid" if invalid else error.reason or "Refused"
    kind, name, words = item.get("kind") or write.resource.plural, kube_objects.name(item), error.message
    if _alike(write) is not None:
        # Each try has another name. Told with it, every try would be news, and that news is looked at by trying again.
        stem = f"{name.rpartition('-')[0]}-*"
        name, words = stem, words.replace(name, stem)
    return Problem(reason, f"{kind} {name}: {words}")
