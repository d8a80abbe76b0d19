"""An API server in memory, with the functions that leader election, events and writes of single objects need."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

from tests.support.answers import json_patched
from understudy.kube.client import ApiError, Client, Object, Resource


class MemoryClient(Client):
    """A client whose server is a dictionary: versions, conflicts, merge patches."""

    def __init__(self) -> None:
        self.items: dict[tuple[str, str, str], Object] = {}
        self.requests: list[tuple[str, str, Any]] = []
        self.failing: Callable[[str, str], Exception | None] = lambda method, name: None
        self._versions = itertools.count(1)

    def _note(self, method: str, name: str, body: Any = None) -> None:
        self.requests.append((method, name, body))
        if error := self.failing(method, name):
            raise error

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
        version = str(next(self._versions))
        made["metadata"] |= {"resourceVersion": version, "uid": f"uid-{version}", "namespace": namespace}
        self.items[place] = made
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
        found["metadata"]["resourceVersion"] = str(next(self._versions))
        return copy.deepcopy(found)

    def _patched(self, place: tuple[str, str, str], operations: list[Object]) -> Object:
        self.items[place] = found = json_patched(self.items[place], operations)
        found["metadata"]["resourceVersion"] = str(next(self._versions))
        return copy.deepcopy(found)

    async def delete(self, resource: Resource, namespace: str | None, name: str, **_: Any) -> None:
        self._note("DELETE", name)
        self.items.pop((resource.plural, namespace or "", name), None)


def merge(target: Object, patch: Object) -> None:
    """A JSON merge patch (RFC 7396)."""
    for key, value in patch.items():
        if value is None:
            target.pop(key, None)
        elif isinstance(value, dict) and isinstance(target.get(key), dict):
            merge(target[key], value)
        else:
            target[key] = copy.deepcopy(value)
