"""Pods that were requested but not yet observed. Counting them prevents extra pods after a stale read."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable

from understudy.controller.pods.pod_counts import EXPECTED_SECONDS
from understudy.controller.reconcile.change_index import Key


class Expectations:
    """Names of pods that count although they have not been observed."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._names: dict[tuple[Key, str], dict[str, float]] = defaultdict(dict)

    def expect(self, key: Key, pool: str, name: str) -> None:
        """Record that a pod is about to be requested."""
        self._names[(key, pool)][name] = self._clock()

    def settled(self, key: Key, pool: str, name: str) -> None:
        """Forget a pod that was observed, or that the API server refused."""
        self._names.get((key, pool), {}).pop(name, None)

    def count(self, key: Key, pool: str, *, observed: Callable[[str], bool] = lambda name: False) -> int:
        """Return how many pods are still expected. Those that ``observed`` knows by name are no longer expected."""
        known = self._names.get((key, pool))
        if not known:
            return 0
        now = self._clock()
        for name in [name for name, since in known.items() if now - since >= EXPECTED_SECONDS or observed(name)]:
            del known[name]
        return len(known)

    def forget(self, key: Key) -> None:
        """Forget the expectations of a deleted object."""
        self._names = defaultdict(dict, {place: known for place, known in self._names.items() if place[0] != key})
