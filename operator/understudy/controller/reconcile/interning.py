"""What objects say alike is kept once: those of a fleet's robots differ in names and in little else.

What is stored is never changed in place, so nobody can tell.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from understudy.kube.client import Object

PARTS = frozenset({"spec", "rules", "subjects", "roleRef", "data", "status"})
"""Where objects of different robots are alike."""

ALIKE = frozenset({"namespace", "labels", "ownerReferences", "creationTimestamp"})
"""What of its metadata an object has in common with the others of its robot."""

REMEMBERED_SECONDS = 60.0
"""For at least so long, and at most twice, what was seen is looked for in other objects: a fleet's come together, in lists."""

Known = dict[tuple[Any, ...], Any]


class Sharing:
    """Finds parts that are equal."""

    def __init__(self, *, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._known: Known = {}
        self._before: Known = {}
        self._turned = clock()

    def of(self, item: Object, old: Object | None) -> Object:
        """The object with the parts that it has in common with its older self, or with another one."""
        self.forget()
        older = old or {}
        shared = self._each(item, older, PARTS)
        if "metadata" in item:
            shared["metadata"] = self._each(item["metadata"], older.get("metadata") or {}, ALIKE)
        return shared

    def forget(self) -> None:
        """Forget what wasn't seen for long; to be called now and then where nothing new comes."""
        if self._clock() - self._turned >= REMEMBERED_SECONDS:
            self._turned, self._before, self._known = self._clock(), self._known, {}

    def _each(self, item: Object, old: Object, parts: frozenset[str]) -> Object:
        return {key: self._part(value, old.get(key)) if key in parts else value for key, value in item.items()}

    def _part(self, value: Any, older: Any) -> Any:
        return older if older is not None and older == value else self._same(value)

    def _same(self, value: Any) -> Any:
        key: tuple[Any, ...]
        # The id of a part stands for all of it: it is kept as long as the entry that has it.
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
