"""A work queue of keys. One worker at a time has a key, and failed keys wait longer each time.

A key that is added while a worker has it is processed once more.
"""

from __future__ import annotations

import asyncio
from collections.abc import Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)

FIRST_RETRY, LAST_RETRY = 0.2, 60.0  # seconds


class Queue(Generic[K]):
    """Keys to be processed, by the rules of client-go's workqueue."""

    def __init__(self, *, first_retry: float = FIRST_RETRY, last_retry: float = LAST_RETRY) -> None:
        self._first, self._last = first_retry, last_retry
        self._order: asyncio.Queue[K] = asyncio.Queue()
        self._taking = asyncio.Lock()
        self._waiting: set[K] = set()
        self._working: set[K] = set()
        self._again: set[K] = set()
        self._timers: dict[K, asyncio.TimerHandle] = {}
        self._failures: dict[K, int] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, key: K) -> None:
        """Enqueue a key. Requests before a worker takes it are merged."""
        if key in self._working:
            self._again.add(key)
        elif key not in self._waiting:
            self._waiting.add(key)
            self._order.put_nowait(key)

    def add_after(self, key: K, delay: float) -> None:
        """Enqueue a key after this number of seconds. The earliest request counts."""
        loop = asyncio.get_running_loop()
        due = loop.time() + delay
        timer = self._timers.get(key)
        if timer is not None:
            if timer.when() <= due:
                return
            timer.cancel()
        self._timers[key] = loop.call_at(due, self._due, key)

    def _due(self, key: K) -> None:
        self._timers.pop(key, None)
        self.add(key)

    async def take(self) -> K:
        """Wait for the next key and hold it until :meth:`done`.

        Workers get their keys in different turns of the event loop. What they do first computes for up to 20 ms, and all workers in the
        same turn would keep everything else waiting.
        """
        async with self._taking:
            await asyncio.sleep(0)
            key = await self._order.get()
        self._waiting.discard(key)
        self._working.add(key)
        return key

    def done(self, key: K) -> None:
        """Release a key. If it was added meanwhile, it is enqueued again."""
        self._working.discard(key)
        if key in self._again:
            self._again.discard(key)
            self.add(key)

    def retry(self, key: K) -> float:
        """Enqueue a failed key again, later after each failure, and return the delay in seconds."""
        failures = self._failures.get(key, 0)
        self._failures[key] = failures + 1
        delay = min(self._last, self._first * 2.0 ** min(failures, 20))
        self.add_after(key, delay)
        return delay

    def succeeded(self, key: K) -> None:
        """Forget a key's failures."""
        self._failures.pop(key, None)

    def close(self) -> None:
        """Cancel all delayed keys."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
