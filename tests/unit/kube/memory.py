"""An API server in memory: single objects, lists and watches."""

from __future__ import annotations

import asyncio
import copy
import json
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

import pytest

from tests.support.answers import json_patched
from understudy.kube.api_contact import ApiContact
from understudy.kube.client import CONFIG_MAPS, ApiError, Client, Object, Resource


class MemoryClient(Client):
    """A client whose server is a dictionary: versions, conflicts, merge patches, watches."""

    def __init__(self) -> None:
        self.contact = ApiContact()
        self.items: dict[tuple[str, str, str], Object] = {}
        self.requests: list[tuple[str, str, Any]] = []
        self.failing: Callable[[str, str], Exception | None] = lambda method, name: None
        self._version = 0
        self._log: list[tuple[int, str, tuple[str, str, str], Object]] = []
        """Every change: its version, the type of its event, the object's place and the object then."""
        self._logged = asyncio.Event()

    def _next_version(self) -> str:
        self._version += 1
        return str(self._version)

    def _changed(self, place: tuple[str, str, str], event: str = "MODIFIED") -> None:
        self._log.append((self._version, event, place, copy.deepcopy(self.items[place])))
        self._logged.set()
        self._logged = asyncio.Event()

    def _note(self, method: str, name: str, body: Any = None) -> None:
        self.requests.append((method, name, body))
        error = self.failing(method, name)
        with self.contact.asking():
            if error is not None and (not isinstance(error, ApiError) or error.unauthenticated):
                raise error
        if error is not None:
            raise error

    def hang_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Have the next patch sent on a dead connection: it gets no answer, and is not carried out."""
        write = self.patch

        async def hang(*_: object, **__: object) -> Object:
            monkeypatch.setattr(self, "patch", write)
            await asyncio.Event().wait()
            raise AssertionError

        monkeypatch.setattr(self, "patch", hang)

    def store(self, resource: Resource, namespace: str, item: Object) -> Object:
        """Have an object as others wrote it, at the next version. Returns it as a watch reports it."""
        name, version = item["metadata"]["name"], self._next_version()
        metadata = {"uid": f"uid-{version}", **item["metadata"], "namespace": namespace, "resourceVersion": version}
        self.items[resource.plural, namespace, name] = stored = copy.deepcopy({**item, "metadata": metadata})
        self._changed((resource.plural, namespace, name))
        return copy.deepcopy(stored)

    async def get(self, resource: Resource, namespace: str | None, name: str) -> Object:
        self._note("GET", name)
        found = self.items.get((resource.plural, namespace or "", name))
        if found is None:
            raise ApiError(404, "NotFound", f"{name} not found")
        return copy.deepcopy(found)

    async def create(self, resource: Resource, namespace: str | None, body: Object, *, dry_run: bool = False) -> Object:
        name = body["metadata"]["name"]
        self._note("POST", name, body)
        place = (resource.plural, namespace or "", name)
        if place in self.items:
            raise ApiError(409, "AlreadyExists", f"{name} exists")
        made = copy.deepcopy(body)
        version = self._next_version()
        made["metadata"] |= {"resourceVersion": version, "uid": f"uid-{version}", "namespace": namespace}
        self.items[place] = made
        self._changed(place, "ADDED")
        return copy.deepcopy(made)

    async def patch(
        self,
        resource: Resource,
        namespace: str | None,
        name: str,
        body: Any,
        *,
        kind: str = "",
        subresource: str | None = None,
    ) -> Object:
        self._note("PATCH", name, body)
        place = (resource.plural, namespace or "", name)
        found = self.items.get(place)
        if found is None:
            raise ApiError(404, "NotFound", f"{name} not found")
        if isinstance(body, list):
            return self._patched(place, body)
        metadata = body.get("metadata") or {}
        for key in ("resourceVersion", "uid"):
            if key in metadata and metadata[key] != found["metadata"][key]:
                raise ApiError(409, "Conflict", f"{name} has changed")
        merge(found, body)
        found["metadata"]["resourceVersion"] = self._next_version()
        self._changed(place)
        return copy.deepcopy(found)

    def _patched(self, place: tuple[str, str, str], operations: list[Object]) -> Object:
        self.items[place] = found = json_patched(self.items[place], operations)
        found["metadata"]["resourceVersion"] = self._next_version()
        self._changed(place)
        return copy.deepcopy(found)

    async def delete(self, resource: Resource, namespace: str | None, name: str, **options: Any) -> Object | None:
        self._note("DELETE", name, options)
        place = (resource.plural, namespace or "", name)
        if place not in self.items or options.get("uid") not in (None, self.items[place]["metadata"]["uid"]):
            return None
        self.items[place]["metadata"]["resourceVersion"] = self._next_version()
        self._changed(place, "DELETED")
        return self.items.pop(place)

    async def list(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        labels: str | None = None,
        fields: str | None = None,
        cached: bool = False,
    ) -> Object:
        self._note("LIST", resource.plural)
        found = [
            item for place, item in self.items.items() if _selected(place, item, resource, namespace, labels, fields)
        ]
        return {"metadata": {"resourceVersion": str(self._version)}, "items": copy.deepcopy(found)}

    async def table(self, resource: Resource, namespace: str, *, labels: str, fields: str) -> Object:
        return await self.list(resource, namespace, labels=labels)  # as a server without tables does

    async def watch(
        self,
        resource: Resource,
        namespace: str | None = None,
        *,
        version: str,
        labels: str | None = None,
        fields: str | None = None,
        lifetime: int | None = None,
    ) -> AsyncIterator[tuple[str, Object]]:
        sent = 0
        while True:
            while sent < len(self._log):
                at, event, place, item = self._log[sent]
                sent += 1
                if at > int(version) and _selected(place, item, resource, namespace, labels, fields):
                    yield event, copy.deepcopy(item)
            await self._logged.wait()


def _selected(
    place: tuple[str, str, str],
    item: Object,
    resource: Resource,
    namespace: str | None,
    labels: str | None,
    fields: str | None,
) -> bool:
    """Whether an object is in a collection: by one name, or by labels and their values."""
    if place[:2] != (resource.plural, namespace or ""):
        return False
    if fields is not None and fields != f"metadata.name={place[2]}":
        return False
    present = item["metadata"].get("labels") or {}
    return all(
        present.get(key) == value if equal else key in present
        for key, equal, value in (term.partition("=") for term in (labels or "").split(",") if term)
    )


class ApplyingClient(MemoryClient):
    """Takes server-side apply, of objects that are not there yet, for a write of the whole object."""

    async def request(self, method: str, path: str, *, body: Any = None, **_: Any) -> Any:
        return await self.create(CONFIG_MAPS, "fleet", body)


class ListingClient(Client):
    """Lists what there is, by resource, in one page each."""

    def __init__(self, items: dict[Resource, list[Object]]) -> None:
        self.items = items
        self.lists = 0

    async def read(self, path: str, *, params: Mapping[str, str] | None = None) -> bytes:
        self.lists += 1
        plural = path.rpartition("/")[2]
        found = [item for resource, items in self.items.items() if resource.plural == plural for item in items]
        metadata = {"resourceVersion": "100"}
        return json.dumps({"kind": "List", "apiVersion": "v1", "metadata": metadata, "items": found}).encode()


def merge(target: Object, patch: Object) -> None:
    """A JSON merge patch (RFC 7396)."""
    for key, value in patch.items():
        if value is None:
            target.pop(key, None)
        elif isinstance(value, dict) and isinstance(target.get(key), dict):
            merge(target[key], value)
        else:
            target[key] = copy.deepcopy(value)
