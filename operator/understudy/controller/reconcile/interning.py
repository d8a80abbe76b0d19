"""Stores equal parts of objects once, because the objects of a fleet's robots differ in little more than their names.

This is safe, because stored objects are never changed in place.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from understudy.api.nesting import has_too_many
from understudy.kube.client import Object

PARTS = frozenset({"spec", "rules", "subjects", "roleRef", "data", "status"})
"""Fields in which the objects of different robots are alike."""

ALIKE = frozenset({"namespace", "labels", "ownerReferences", "creationTimestamp"})
"""Metadata fields that an object has in common with the other objects of its robot."""

REMEMBERED_SECONDS = 60.0
"""Minimum time, in seconds, for which a part is remembered; the maximum is twice as long.

A fleet's objects arrive together, in lists.
"""

Known = dict[tuple[Any, ...], Any]


class Interner:
    """Finds equal parts."""

    def __init__(self, *, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._known: Known = {}
        self._before: Known = {}
        self._turned = clock()

    def of(self, item: Object, old: Object | None) -> Object:
        """Return the object with the parts that it shares with its older version or with other objects."""
        self.forget()
        older = old or {}
        shared = self._each(item, older, PARTS)
        if "metadata" in item:
            shared["metadata"] = self._each(item["metadata"], older.get("metadata") or {}, ALIKE)
        return shared

    def forget(self) -> None:
        """Forget parts that were not seen for a while. Call it from time to time if no new objects arrive."""
        if self._clock() - self._turned >= REMEMBERED_SECONDS:
            self._turned, self._before, self._known = self._clock(), self._known, {}

    def _each(self, item: Object, old: Object, parts: frozenset[str]) -> Object:
        return {key: self._part(value, old.get(key)) if key in parts else value for key, value in item.items()}

    def _part(self, value: Any, older: Any) -> Any:
        if older is not None and older == value:
            return older
        # No object that is accepted has so many, and to look for each of them would keep the event loop busy.
        large = isinstance(value, dict | list) and has_too_many(value)
        return value if large else self._same(value)

    def _same(self, value: Any) -> Any:
        key: tuple[Any, ...]
        if type(value) is str:
            return sys.intern(value)
        # The id of a part identifies its whole content: the part is kept as long as the entry that contains it.
        if isinstance(value, dict):
            value = {sys.intern(name): self._same(part) for name, part in value.items()}
            key = (dict, *((name, id(part)) for name, part in value.items()))
        elif isinstance(value, list):
            value = [self._same(part) for part in value]
            key = (list, *map(id, value))
        else:
            key = (type(value), value)
        if key not in self._known:
            self._known[key] = self._before.get(key, value)
        return self._known[key]
