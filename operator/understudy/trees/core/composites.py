"""Composites whose three-valued result differs from py_trees' own."""

from __future__ import annotations

from collections.abc import Iterator

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Composite


class AnyOf(Composite):
    """Succeeds if any child succeeds, regardless of the others.

    py_trees' Selector stops at the first running child, so a child that is still starting would hide a healthy one
    behind it. This composite ticks all children: it succeeds if one succeeds, else it is running if one is running,
    else it fails.
    """

    def __init__(self, name: str, children: list[Behaviour]) -> None:
        super().__init__(name, children)

    def tick(self) -> Iterator[Behaviour]:
        """Tick every child; the best status is the result."""
        results = []
        for child in self.children:
            yield from child.tick()
            results.append(child.status)
        if Status.SUCCESS in results:
            self.status = Status.SUCCESS
        elif Status.RUNNING in results:
            self.status = Status.RUNNING
        else:
            self.status = Status.FAILURE
        yield self


class FirstOf(Composite):
    """Tries its children in order until one succeeds, each once.

    py_trees' Selector with memory forgets why the earlier ones failed.
    """

    def __init__(self, name: str, children: list[Behaviour]) -> None:
        super().__init__(name, children)
        self._place = 0

    def tick(self) -> Iterator[Behaviour]:
        """Continue with the running child, or with the next one after a failure."""
        if self.status != Status.RUNNING:
            self._place = 0
        self.status = Status.FAILURE
        while self._place < len(self.children):
            child = self.children[self._place]
            yield from child.tick()
            if child.status != Status.FAILURE:
                self.status = child.status
                break
            self._place += 1
        yield self
