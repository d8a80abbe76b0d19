"""A model of the Kubernetes API: versions, preconditions, the patches that are used, and a history for watches.

What is stored is never changed in place, so that what was read stays as it was and a copy of everything costs little.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

from tests.support.answers import json_patched
from understudy.kube.client import APPLY, JSON, ApiError, Object

EPOCH = 1_700_000_000.0
"""Unix seconds at which virtual time begins."""

CUSTOM = ("robotworkloads", "failurepolicies", "fallbackpools")
KINDS = {
    "pods": ("v1", "Pod"),
    "services": ("v1", "Service"),
    "configmaps": ("v1", "ConfigMap"),
    "secrets": ("v1", "Secret"),
    "serviceaccounts": ("v1", "ServiceAccount"),
    "deployments": ("apps/v1", "Deployment"),
    "replicasets": ("apps/v1", "ReplicaSet"),
    "statefulsets": ("apps/v1", "StatefulSet"),
    "networkpolicies": ("networking.k8s.io/v1", "NetworkPolicy"),
    "poddisruptionbudgets": ("policy/v1", "PodDisruptionBudget"),
    "nodes": ("v1", "Node"),
    "roles": ("rbac.authorization.k8s.io/v1", "Role"),
    "rolebindings": ("rbac.authorization.k8s.io/v1", "RoleBinding"),
    "robotworkloads": ("understudy.dev/v1alpha1", "RobotWorkload"),
    "failurepolicies": ("understudy.dev/v1alpha1", "FailurePolicy"),
    "fallbackpools": ("understudy.dev/v1alpha1", "FallbackPool"),
    "leases": ("coordination.k8s.io/v1", "Lease"),
}
_PATH = re.compile(r"/(?:api|apis/[^/]+)/v[^/]+(?:/namespaces/([^/]+))?/([a-z]+)(?:/([^/]+))?(?:/([^/]+))?$")

Place = tuple[str, str]


class Event(NamedTuple):
    """A write."""

    version: int
    old: Object | None
    new: Object | None


class ApiServer:
    """Objects by plural, namespace and name."""

    def __init__(
        self, clock: Callable[[], float], applied: Mapping[tuple[str, Place, str, str], Object] | None = None
    ) -> None:
        """``applied`` is what each writer has applied before."""
        self._clock = clock
        self.version = 1000
        self.items: dict[str, dict[Place, Object]] = defaultdict(dict)
        self._applied = dict(applied or {})
        self.history: dict[str, list[Event]] = defaultdict(list)
        self.unlisted: dict[Place, Object] = {}
        """The pods of monitors, which can be read one by one and are in no list and no watch."""
        self._encoded: dict[str, bytes] = {}
        """Objects as JSON, by their versions."""
        self.changed: Callable[[str, Object | None, Object | None, str], None] = lambda plural, old, new, by: None
        """Called after every write: plural, what was, what is, and who wrote."""

    def restored(self, clock: Callable[[], float]) -> ApiServer:
        """Another server that has the same objects, and whose history begins here."""
        made = ApiServer(clock, self._applied)
        made.version = self.version
        made.items = defaultdict(dict, {plural: dict(items) for plural, items in self.items.items()})
        made._encoded = {item["metadata"]["resourceVersion"]: self.encoded(item) for item in made._all()}
        return made

    def _all(self) -> Iterator[Object]:
        return (item for items in self.items.values() for item in items.values())

    # -- requests ---------------------------------------------------------------------------------------------------

    def request(
        self, method: str, path: str, params: Mapping[str, str] | None, body: Any, content_type: str, by: str
    ) -> Object:
        """Carry out a request. Raises ApiError."""
        found = _PATH.match(path)
        assert found is not None, path
        namespace, plural, name, subresource = found.groups()
        params = params or {}
        if method == "POST":
            return self._create(plural, namespace, body, by, dry_run="dryRun" in params)
        if name is None:
            return self._list(plural, namespace, params)
        place = (namespace or "", name)
        if method == "GET" and plural == "pods" and place in self.unlisted:
            return self.unlisted[place]
        if method == "GET":
            return self._existing(plural, place)
        if method == "DELETE":
            return self._delete(plural, place, body or {}, by)
        if content_type == APPLY:
            return self._apply(plural, place, body, params["fieldManager"], subresource or "", by)
        if content_type == JSON:
            return self.write(plural, place, json_patched(self._existing(plural, place), body), by)
        return self._patch(plural, place, body, subresource or "", by)

    def get(self, plural: str, place: Place) -> Object | None:
        """An object, or None."""
        return self.items[plural].get(place)

    def encoded(self, item: Object) -> bytes:
        """An object as JSON."""
        version = item["metadata"]["resourceVersion"]
        if version not in self._encoded:
            self._encoded[version] = json.dumps(item, separators=(",", ":")).encode()
        return self._encoded[version]

    def _existing(self, plural: str, place: Place) -> Object:
        found = self.items[plural].get(place)
        if found is None:
            raise ApiError(404, "NotFound", f'{plural} "{place[1]}" not found')
        return found

    def _list(self, plural: str, namespace: str | None, params: Mapping[str, str]) -> Object:
        chosen = selecting(params.get("labelSelector"), params.get("fieldSelector"))
        version, kind = KINDS[plural]
        at = int(params.get("resourceVersion") or self.version)
        return {
            "apiVersion": version,
            "kind": f"{kind}List",
            "metadata": {"resourceVersion": str(at)},
            "items": [
                item
                for place, item in sorted(self._as_of(plural, at).items())
                if (namespace is None or place[0] == namespace) and chosen(item)
            ],
        }

    def _as_of(self, plural: str, version: int) -> dict[Place, Object]:
        """The objects as they were at a version."""
        items = dict(self.items[plural])
        for event in reversed(self.history[plural][self.since(plural, version) :]):
            item = event.old or event.new
            assert item is not None
            place = (item["metadata"].get("namespace") or "", item["metadata"]["name"])
            items.pop(place, None)
            if event.old is not None:
                items[place] = event.old
        return items

    def _create(self, plural: str, namespace: str | None, body: Object, by: str, *, dry_run: bool) -> Object:
        place = (namespace or "", body["metadata"]["name"])
        if place in self.items[plural]:
            raise ApiError(409, "AlreadyExists", f'{plural} "{place[1]}" already exists')
        if dry_run:
            return body
        version, kind = KINDS[plural]
        metadata = {
            **body["metadata"],
            "namespace": place[0],
            "uid": f"uid-{self.version + 1}",
            "creationTimestamp": stamp(self._clock()),
            "generation": 1,
        }
        made = {**body, "apiVersion": version, "kind": kind, "metadata": metadata}
        if plural == "replicasets":
            made["spec"] = {"replicas": 1, **made["spec"]}
        return self.write(plural, place, made, by)

    def _patch(self, plural: str, place: Place, body: Object, subresource: str, by: str) -> Object:
        old = self._existing(plural, place)
        wanted = body.get("metadata") or {}
        for key in ("uid", "resourceVersion"):
            if key in wanted and wanted[key] != old["metadata"][key]:
                raise ApiError(409, "Conflict", f'{plural} "{place[1]}": {key} is {old["metadata"][key]}')
        patch = {**body, "metadata": {k: v for k, v in wanted.items() if k not in ("uid", "resourceVersion")}}
        if subresource == "scale":
            patch = {"spec": {"replicas": body["spec"]["replicas"]}}
        return self.write(plural, place, merged(old, patch), by)

    def _apply(self, plural: str, place: Place, body: Object, manager: str, subresource: str, by: str) -> Object:
        live = self.items[plural].get(place)
        uid = body["metadata"].get("uid")
        if live is None:
            if uid is not None or subresource:
                raise ApiError(
                    409 if uid is not None else 404, "Conflict", f'{plural} "{place[1]}": there is none of that UID'
                )
        elif uid is not None and live["metadata"]["uid"] != uid:
            raise ApiError(409, "Conflict", f'{plural} "{place[1]}": the UID is {live["metadata"]["uid"]}')
        applied_body = {"status": body["status"]} if subresource == "status" else _whole(body)
        key = (plural, place, manager, subresource)
        before = self._applied.get(key, {})
        self._applied[key] = applied_body
        if live is None:
            return self._create(plural, place[0], applied_body, by, dry_run=False)
        return self.write(plural, place, applied(live, before, applied_body), by)

    def _delete(self, plural: str, place: Place, options: Object, by: str) -> Object:
        old = self._existing(plural, place)
        for key, value in (options.get("preconditions") or {}).items():
            if old["metadata"][key] != value:
                raise ApiError(409, "Conflict", f'{plural} "{place[1]}": {key} is {old["metadata"][key]}')
        graceful = plural == "pods" and old["spec"].get("nodeName") and options.get("gracePeriodSeconds") != 0
        if not graceful or (old.get("status") or {}).get("phase") in ("Failed", "Succeeded"):
            self.write(plural, place, None, by)
        elif "deletionTimestamp" not in old["metadata"]:
            metadata = {**old["metadata"], "deletionTimestamp": stamp(self._clock())}
            return self.write(plural, place, {**old, "metadata": metadata}, by)
        return old

    # -- writing ----------------------------------------------------------------------------------------------------

    def update(self, plural: str, place: Place, change: Callable[[Object], Object], by: str) -> None:
        """Change an object if it's still there."""
        old = self.items[plural].get(place)
        if old is not None:
            self.write(plural, place, change(old), by)

    def write(self, plural: str, place: Place, new: Object | None, by: str) -> Object:
        """Store an object, or that it's gone. What changes nothing is no write."""
        old = self.items[plural].get(place)
        if new is not None and new == old:
            return new
        self.version += 1
        if new is None:
            assert old is not None
            del self.items[plural][place]
        else:
            metadata = {**new["metadata"], "resourceVersion": str(self.version)}
            if old is not None and old.get("spec") != new.get("spec"):
                metadata["generation"] = old["metadata"]["generation"] + 1
            new = {**new, "metadata": metadata}
            self.items[plural][place] = new
        self.history[plural].append(Event(self.version, old, new))
        self.changed(plural, old, new, by)
        return new or {}

    def since(self, plural: str, version: int) -> int:
        """Where in the history of a resource a watch from a version begins."""
        return bisect_right(self.history[plural], version, key=lambda event: event.version)


def watch_event(event: Event, chosen: Callable[[Object], bool]) -> tuple[str, Object] | None:
    """Returns the event of a watch for a write; None if the watch does not select the object."""
    was = event.old is not None and chosen(event.old)
    if event.new is not None and chosen(event.new):
        return ("MODIFIED" if was else "ADDED"), event.new
    if not was:
        return None
    assert event.old is not None
    metadata = {**event.old["metadata"], "resourceVersion": str(event.version)}
    return "DELETED", {**event.old, "metadata": metadata}


def selecting(labels: str | None, fields: str | None) -> Callable[[Object], bool]:
    """Whether a list or watch with these selectors has an object."""
    wanted = [_requirement(part) for part in labels.split(",")] if labels else []
    path, _, value_of_field = (fields or "").partition("=")
    where = path.split(".")

    def chosen(item: Object) -> bool:
        if fields and (item.get(where[0]) or {}).get(where[1]) != value_of_field:
            return False
        found = item["metadata"].get("labels") or {}
        return all(
            (key in found) is present and (value is None or found.get(key) == value) for key, present, value in wanted
        )

    return chosen


def _requirement(part: str) -> tuple[str, bool, str | None]:
    key, equals, value = part.partition("=")
    if equals:
        return key, True, value
    return key.removeprefix("!"), not key.startswith("!"), None


def merged(target: Any, patch: Any) -> Any:
    """A JSON merge patch (RFC 7396), as a new object."""
    if not isinstance(patch, dict):
        return patch
    made = dict(target) if isinstance(target, dict) else {}
    for key, value in patch.items():
        if value is None:
            made.pop(key, None)
        else:
            made[key] = merged(made.get(key), value)
    return made


def applied(live: Any, before: Any, body: Any) -> Any:
    """A server-side apply: removes the fields that this manager no longer gives, and sets those that it gives."""
    if isinstance(body, dict) and isinstance(live, dict):
        known = before if isinstance(before, dict) else {}
        made = {key: value for key, value in live.items() if key not in known or key in body}
        for key, value in body.items():
            made[key] = (
                _conditions(live, known, body) if key == "conditions" else applied(live.get(key), known.get(key), value)
            )
        return made
    return body


def _conditions(live: Object, before: Object, body: Object) -> list[Object]:
    """Conditions are a map by their type: each manager has its own."""
    mine = {condition["type"]: condition for condition in body["conditions"]}
    gone = {condition["type"] for condition in before.get("conditions") or []} - mine.keys()
    others = {c["type"]: c for c in live.get("conditions") or [] if c["type"] not in gone}
    return [value for _, value in sorted((others | mine).items())]


def _whole(body: Object) -> Object:
    metadata = {key: value for key, value in body["metadata"].items() if key not in ("uid", "resourceVersion")}
    return {**{key: value for key, value in body.items() if key != "status"}, "metadata": metadata}


def stamp(moment: float) -> str:
    """Unix seconds as Kubernetes writes them."""
    return datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
