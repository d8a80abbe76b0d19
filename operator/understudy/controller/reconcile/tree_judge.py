"""Lets another process check the trees of objects, and remembers the verdicts.

Nothing waits for a check: an object with an unchecked tree is reconciled again after it. So no namespace can keep the
operator from its other work. The namespaces take turns, so that none can make the others wait for long.

Verdicts are not kept across restarts: the common tree is checked within 10 ms, which a new leader can do again.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from typing import Protocol

from understudy.controller.reconcile.change_index import Key
from understudy.trees.languages.tree_check import TreeText, Verdict

_logger = logging.getLogger(__name__)

REMEMBERED_MOST = 2**25
"""Most characters of all remembered verdicts."""

_PER_VERDICT = 256
"""Characters that a verdict counts for besides its texts."""

IDLE_SECONDS = 30.0
"""Seconds without a tree after which the other process is ended."""

RETRY_SECONDS = 1.0
"""Seconds until the next attempt if the process cannot be started."""


class Checker(Protocol):
    """Checks trees. :class:`understudy.process.tree_checker.TreeChecker` implements it."""

    @property
    def running(self) -> bool:
        """Whether it holds a process."""

    async def check(self, tree: TreeText) -> Verdict:
        """Check a tree. Raises OSError if that is not possible now."""

    async def close(self, *, kill: bool = False) -> None:
        """End its process."""


class TreeJudge:
    """Verdicts about trees, and the trees that wait for theirs."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._known: OrderedDict[bytes, Verdict] = OrderedDict()
        self._size = 0
        self._waiting: OrderedDict[str, dict[Key, TreeText]] = OrderedDict()
        """By namespace, the next one first: the objects that wait, the earliest first, each with its tree."""
        self._added = asyncio.Event()
        self.judged: Callable[[Key], None] = lambda key: None
        """Called with each object that waited for a verdict."""

    def find(self, tree: TreeText) -> Verdict | None:
        """Return the verdict about a tree, if it is known."""
        verdict = self._known.get(tree.digest)
        if verdict is not None:
            self._known.move_to_end(tree.digest)
        return verdict

    def submit(self, tree: TreeText, key: Key) -> None:
        """Have a tree of an object checked. An earlier tree for which the object waits is forgotten."""
        self._waiting.setdefault(key.namespace, {})[key] = tree
        self._added.set()

    async def run(self) -> None:
        """Check trees until cancelled."""
        try:
            while True:
                await self._wait()
                await self._next()
        finally:
            await self._checker.close(kill=True)

    async def _wait(self) -> None:
        """Wait for a tree, and end the other process if none comes."""
        while not self._waiting:
            self._added.clear()
            try:
                async with asyncio.timeout(IDLE_SECONDS if self._checker.running else None):
                    await self._added.wait()
            except TimeoutError:
                await self._checker.close()

    async def _next(self) -> None:
        """Check one tree of the namespace whose turn it is."""
        namespace, objects = next(iter(self._waiting.items()))
        tree = next(iter(objects.values()))
        try:
            if self.find(tree) is None:
                self._remember(tree, await self._checker.check(tree))
        except OSError as error:
            _logger.warning("no process to check trees can be started: %s; retry in %g s", error, RETRY_SECONDS)
            await asyncio.sleep(RETRY_SECONDS)
            return
        for key in [key for key, other in objects.items() if other.digest == tree.digest]:
            del objects[key]
            self.judged(key)
        self._waiting.move_to_end(namespace)
        if not objects:
            del self._waiting[namespace]

    def _remember(self, tree: TreeText, verdict: Verdict) -> None:
        self._known[tree.digest] = verdict
        self._size += _size(verdict)
        while self._size > REMEMBERED_MOST and len(self._known) > 1:
            _, oldest = self._known.popitem(last=False)
            self._size -= _size(oldest)


def _size(verdict: Verdict) -> int:
    return _PER_VERDICT + len(verdict.message) + len(verdict.tree)
