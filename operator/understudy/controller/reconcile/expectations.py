"""Pods that were asked for and haven't been observed, so that a stale read never makes too many."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable

from understudy.controller.pods.pod_counts import EXPECTED_SECONDS
from understudy.controller.reconcile.change_index import Key


class Expectations:
    """Names of pods that count though nobody has seen them."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._names: dict[tuple[Key, str], dict[str, float]] = defaultdict(dict)

    def expect(self, key: Key, pool: str, name: str) -> None:
        """A pod is about to be asked for."""
        self._names[(key, pool)][name] = self._clock()

    def settled(self, key: Key, pool: str, name: str) -> None:
        """It was observed, or the API server said that it won't be."""
        self._names.get((key, pool), {}).pop(name, None)

    def count(self, key: Key, pool: str, *, observed: Callable[[str], bool] = lambda name: False) -> int:
        """How many are still expected; those that were observed meanwhile, by their names, no longer are."""
        known = self._names.get((key, pool))
        if not known:
            return 0
        now = self._clock()
        for name in [name for name, since in known.items() if now - since >= EXPECTED_SECONDS or observed(name)]:
            del known[name]
        return len(known)

    def forget(self, key: Key) -> None:
        """Nothing is expected any more of one that is gone."""
        self._names = defaultdict(dict, {place: known for place, known in self._names.items() if place[0] != key})
