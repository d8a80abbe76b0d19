"""A copy of the observed cluster, updated by watches, lists and the answers to the operator's own writes.

A watch may be late, repeat events or fall silent. So resource versions decide which of two observations of an object is
newer (they are comparable within a resource, KEP-5504). A full list repairs what a watch missed, and shows that it was
missed.
"""

from __future__ import annotations

import logging
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from understudy.api import names
from understudy.controller.reconcile.interning import Interner
from understudy.kube import claims
from understudy.kube.apply import controller_of, released, released_spec
from understudy.kube.client import PODS, Object, Resource
from understudy.kube.gates import registry

_logger = logging.getLogger(__name__)

REMEMBERED_SECONDS = 300.0
"""How long a deleted object is remembered, in seconds, so that a list from before its deletion does not restore it."""

Index = tuple[str, ...]


@dataclass(frozen=True)
class ObservedChange:
    """An observed change."""

    resource: Resource
    old: Object | None
    new: Object | None


class Store:
    """Objects by resource, namespace and name."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._items: dict[str, dict[tuple[str, str], Object]] = defaultdict(dict)
        self._index: dict[Index, dict[tuple[str, str, str], Object]] = defaultdict(dict)
        self._gone: dict[str, tuple[int, float]] = {}
        self._swept = self._changed = clock()
        self._sharing = Interner(clock=clock)
        self.noticed: Callable[[ObservedChange], None] = lambda change: None
        """Called with every change, including those by the operator: a write for one object may affect another."""

    @property
    def quiet(self) -> float:
        """Seconds since the last observed change."""
        return self._clock() - self._changed

    def get(self, resource: Resource, namespace: str, name: str) -> Object | None:
        """Return an object, or None."""
        return self._items[resource.plural].get((namespace, name))

    def gate(self, workload: Object) -> Object | None:
        """Return the gate object of a RobotWorkload, or None."""
        metadata = workload["metadata"]
        return self.get(registry.of(workload).resource, metadata.get("namespace", ""), names.gate(metadata["name"]))

    def knows(self, resource: Resource, item: Object) -> bool:
        """Whether an object of that name is in the store."""
        return self.get(resource, item["metadata"].get("namespace", ""), item["metadata"]["name"]) is not None

    def all(self, resource: Resource) -> list[Object]:
        """Return every object of a resource."""
        return list(self._items[resource.plural].values())

    def in_namespace(self, resource: Resource, namespace: str) -> dict[str, Object]:
        """Return the objects of a resource in a namespace, by name."""
        found = self._index.get(("namespace", resource.plural, namespace), {})
        return {name: item for (_, _, name), item in found.items()}

    def owned(self, uid: str) -> dict[tuple[str, str], Object]:
        """Return the objects that the object with this UID controls, by plural and name."""
        found = self._index.get(("owner", uid), {})
        return {(plural, name): item for (plural, _, name), item in found.items()}

    def labelled(self, resource: Resource, namespace: str, label: str, value: str) -> list[Object]:
        """Return the objects with one of the indexed labels (workload, pool, monitored)."""
        return list(self._index.get(("label", resource.plural, namespace, label, value), {}).values())

    def released(self, namespace: str, workload: str) -> list[Object]:
        """Return the instances of a workload that no controller owns, whatever their labels are."""
        return list(self._index.get(("released", namespace, workload), {}).values())

    def put(self, resource: Resource, item: Object) -> ObservedChange | None:
        """Store an observation of an object, and return the change; None if it contains nothing new."""
        metadata = item["metadata"]
        place = (metadata.get("namespace", ""), metadata["name"])
        old = self._items[resource.plural].get(place)
        if old is not None and same(old, item) and version(old) >= version(item):
            return None
        if old is not None and not same(old, item) and version(old) > version(item):
            return None
        gone = self._gone.get(metadata.get("uid", ""))
        if gone is not None and gone[0] >= version(item):
            return None
        new = self._sharing.of(slim(resource, item), old)
        self._unindex(resource, place, old)
        self._items[resource.plural][place] = new
        entry = (resource.plural, *place)
        for key in _keys(resource, new):
            self._index[key][entry] = new
        return self._notice(ObservedChange(resource, old, new))

    def remove(self, resource: Resource, item: Object) -> ObservedChange | None:
        """Record that an object is gone, and return the change; None if that was known."""
        metadata = item["metadata"]
        place = (metadata.get("namespace", ""), metadata["name"])
        self._bury(item)
        old = self._items[resource.plural].get(place)
        if old is None or not same(old, item):
            return None
        del self._items[resource.plural][place]
        self._unindex(resource, place, old)
        return self._notice(ObservedChange(resource, old, None))

    def _notice(self, change: ObservedChange) -> ObservedChange:
        self._changed = self._clock()
        self.noticed(change)
        return change

    def replace(
        self,
        resource: Resource,
        items: Iterable[Object],
        listed: int,
        namespace: str | None,
        *,
        covered: Callable[[Object], bool] = lambda item: True,
    ) -> list[ObservedChange]:
        """Store a list of a resource (of one namespace, or of all) as of version ``listed``, and return the changes.

        ``covered`` says of a stored object whether such a list would contain it.
        """
        self._sharing.forget()
        found = list(items)
        present = {(i["metadata"].get("namespace", ""), i["metadata"]["name"]) for i in found}
        changes = [self._put_listed(resource, item) for item in found]
        for place, old in list(self._items[resource.plural].items()):
            if place in present or (namespace is not None and place[0] != namespace):
                continue
            if version(old) <= listed and covered(old):  # newer ones were created after the list
                changes.append(self.remove(resource, old))
        return [change for change in changes if change is not None]

    def _put_listed(self, resource: Resource, item: Object) -> ObservedChange | None:
        try:
            return self.put(resource, item)
        except Exception:  # an unexpected object must not end the list, and so the protection of all others
            _logger.exception("%s %s", resource.plural, item["metadata"].get("name"))
            return None

    def _bury(self, item: Object) -> None:
        now = self._clock()
        self._gone[item["metadata"].get("uid", "")] = (version(item), now)
        if now - self._swept >= REMEMBERED_SECONDS / 10:
            self._swept = now
            self._gone = {uid: entry for uid, entry in self._gone.items() if now - entry[1] < REMEMBERED_SECONDS}

    def _unindex(self, resource: Resource, place: tuple[str, str], old: Object | None) -> None:
        if old is None:
            return
        for key in _keys(resource, old):
            entries = self._index.get(key)
            if entries is not None:
                entries.pop((resource.plural, *place), None)
                if not entries:
                    del self._index[key]


def _keys(resource: Resource, item: Object) -> list[Index]:
    metadata = item["metadata"]
    namespace = metadata.get("namespace", "")
    found: list[Index] = [("namespace", resource.plural, namespace)]
    owner = controller_of(item)
    if owner is not None:
        found.append(("owner", owner["uid"]))
    elif resource.plural == PODS.plural and (workload := released(item)):
        found.append(("released", namespace, workload))
    labels = metadata.get("labels") or {}
    if workload := claims.workload_of(labels):
        found.append(("label", resource.plural, namespace, names.WORKLOAD, workload))
    found += [
        ("label", resource.plural, namespace, label, labels[label])
        for label in (names.POOL, names.MONITORED)
        if label in labels
    ]
    return found


def version(item: Object) -> int:
    """Return the object's resourceVersion as a number; 0 if it has none."""
    text = item["metadata"].get("resourceVersion", "")
    return int(text) if text.isdigit() else 0


def same(a: Object, b: Object) -> bool:
    """Whether two observations are of one object, and not of two successive objects with the same name."""
    return bool(a["metadata"].get("uid") == b["metadata"].get("uid"))


def slim(resource: Resource, item: Object) -> Object:
    """Return the object without the parts that the operator never reads, because a fleet's copies are kept in memory.

    A Secret loses its data.
    """
    metadata = {sys.intern(key): value for key, value in item["metadata"].items() if key != "managedFields"}
    kept = {**{sys.intern(key): value for key, value in item.items()}, "metadata": metadata}
    if resource.plural == "secrets":
        kept.pop("data", None)
        kept.pop("stringData", None)
    if resource.plural == "pods":
        kept["spec"] = {"nodeName": (item.get("spec") or {}).get("nodeName")}
        if workload := released(item):
            kept["spec"] |= released_spec(workload)
        if token := claims.pool_evidence(item):
            kept["spec"]["volumes"] = [token]
        kept["status"] = _slim_status(item.get("status") or {})
    if resource.plural == "nodes":
        kept["metadata"] = {key: metadata[key] for key in ("name", "uid", "resourceVersion") if key in metadata}
        kept["spec"] = {
            key: found for key in ("unschedulable", "taints") if (found := (item.get("spec") or {}).get(key))
        }
    if resource.plural in _WITHOUT_STATUS:
        kept.pop("status", None)
    return kept


_WITHOUT_STATUS = frozenset(
    {"nodes", "deployments", "replicasets", "services", "poddisruptionbudgets"}
    | {resource.plural for resource in registry.FENCING_RESOURCES}
)
"""Resources whose status is not stored. The operator sees their state by their pods."""


def _slim_status(status: Object) -> Object:
    """Return the part of a pod's status that shows whether it runs, and why not.

    Most pods of a fleet then have equal statuses, which interning.py stores once.
    """
    kept: Object = {"phase": status.get("phase")}
    kept["conditions"] = [_only(one, ("type", "status", "reason", "message")) for one in status.get("conditions") or []]
    for key in ("initContainerStatuses", "containerStatuses"):
        if containers := status.get(key):
            kept[key] = [_slim_container(one) for one in containers]
    return kept


def _slim_container(container: Object) -> Object:
    kept = _only(container, ("name", "image", "restartCount"))
    for key, state in (("state", "waiting"), ("lastState", "terminated")):
        if found := (container.get(key) or {}).get(state):
            kept[key] = {state: _only(found, ("reason", "message", "exitCode"))}
    return kept


def _only(whole: Object, keys: Iterable[str]) -> Object:
    return {key: whole[key] for key in keys if key in whole}
