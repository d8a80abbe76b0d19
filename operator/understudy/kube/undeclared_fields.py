"""Applies objects without the fields that an older definition on the API server does not know.

Server-side apply (KEP-555) refuses an object with unknown fields as a whole, but an update would drop the fields
(kubernetes/kubernetes#122480).
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Sequence
from typing import Any

from understudy.kube.client import ApiError, Client, Object, Resource

_FIELD = re.compile(r"(\.\S+): field not declared in schema")
_STEP = re.compile(r"\.(?P<key>[^.\[\]]+)|\[(?P<index>\d+)\]|\[(?P<entry>[^\]]+)\]")
_IDENTITY = re.compile(r'(\w+)="([^"]*)"')


async def apply_declared(
    client: Client, resource: Resource, namespace: str | None, body: Object, *, manager: str, subresource: str | None
) -> tuple[Object, Sequence[str]]:
    """Apply those fields of an object that its definition knows.

    Returns the resulting object, and the paths of the fields left out. Raises ApiError.
    """
    unknown: list[str] = []
    while True:
        try:
            known = without(body, unknown)
            return await client.apply(resource, namespace, known, manager=manager, subresource=subresource), unknown
        except ApiError as error:
            # The API server names only some of the unknown fields, and not always the same ones.
            found = [field for field in _FIELD.findall(error.message) if field not in unknown]
            if not error.malformed or not found:
                raise
            unknown = sorted([*unknown, *found])


def lacking(resource: Resource, fields: Iterable[str], writer: str) -> str:
    """Return the message for users about the fields that were left out."""
    listed = ", ".join(sorted(fields))
    return f"the definition of {resource.plural} is older than this {writer} and lacks {listed}: upgrade it (charts/understudy, or crds/)"


def without(body: Object, fields: Sequence[str]) -> Object:
    """Return a copy of an object without some fields.

    Each is a path as the API server writes it: ``.a.b``, ``.list[0].b``, ``.list[type="x"].b``.
    """
    found = copy.deepcopy(body)
    for path in fields:
        *way, last = _STEP.finditer(path)
        place: Any = found
        for step in way:
            place = _below(place, step)
        if isinstance(place, dict):
            place.pop(last["key"], None)
    return found


def _below(place: Any, step: re.Match[str]) -> Any:
    if isinstance(place, dict):
        return place.get(step["key"])
    if not isinstance(place, list):
        return None
    if step["index"] is not None:
        return place[int(step["index"])] if int(step["index"]) < len(place) else None
    identity = dict(_IDENTITY.findall(step["entry"] or ""))
    return next((one for one in place if all(one.get(key) == value for key, value in identity.items())), None)
