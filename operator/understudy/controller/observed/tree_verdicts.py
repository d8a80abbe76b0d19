"""What is known of the trees of objects. The pure functions ask here, and do not care who has checked a tree, and when."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar

from understudy.controller.plan import Problem
from understudy.trees.languages.tree_check import TOO_COSTLY, TreeText, Verdict, check

MOST_SECONDS = 6.0
"""Processor time, in seconds, that the checks of all trees of one object may take."""

Lookup = Callable[[TreeText], Verdict | None]
"""Returns the verdict about a tree; None if it was not checked yet."""


class Unjudged(Exception):
    """A tree was not checked yet. Ask again after that."""

    def __init__(self, tree: TreeText) -> None:
        super().__init__(tree.path)
        self.tree = tree


_checked_here = functools.lru_cache(maxsize=512)(check)
_lookup: ContextVar[Lookup] = ContextVar("lookup", default=_checked_here)


@contextlib.contextmanager
def looked_up(lookup: Lookup) -> Iterator[None]:
    """Take verdicts from ``lookup`` meanwhile. Otherwise each tree is checked where it is asked for, which may take long."""
    token = _lookup.set(lookup)
    try:
        yield
    finally:
        _lookup.reset(token)


def of(tree: TreeText) -> Verdict:
    """Return the verdict about a tree. Raises Unjudged."""
    verdict = _lookup.get()(tree)
    if verdict is None:
        raise Unjudged(tree)
    return verdict


def problem(first: Iterable[TreeText], procedures: Iterable[TreeText]) -> Problem | None:
    """Return why the trees of an object are refused; None if they are not.

    Of the ``first``, only one refused tree is reported; of the ``procedures``, all. Raises Unjudged, one tree at a time, so
    that no more trees are checked after the first that is too costly.
    """
    total, refused = 0.0, list[Verdict]()
    for tree, alone in (*((tree, True) for tree in first), *((tree, False) for tree in procedures)):
        verdict = of(tree)
        total += verdict.cost
        if verdict.reason == TOO_COSTLY or (verdict.reason and alone):
            return Problem(verdict.reason, verdict.message)
        if verdict.reason:
            refused.append(verdict)
        elif total > MOST_SECONDS:
            message = f"{tree.path}: with this tree, the checks of the object's trees take {total:.1f} s of processor time, and "
            return Problem(TOO_COSTLY, f"{message}{MOST_SECONDS:g} s are allowed. Use fewer or smaller trees")
    return Problem(refused[0].reason, "; ".join(verdict.message for verdict in refused)) if refused else None
