"""How many values the fields that keep unknown content may have, such as trees and pod templates, and how deeply nested.

The API server cannot refuse deep or large values. A structural schema cannot describe values of any depth and limit the
depth, and CEL rules do not see content that no schema describes. It stores up to 10,000 levels, and Python's functions for
nested values end with a RecursionError at a few hundred. It stores up to 1.5 MiB, which can have 500,000 values: a function
that visits them all would keep the event loop busy for half a second.
"""

from __future__ import annotations

from typing import Any

DEEPEST = 100
"""Most levels of mappings and lists below a value; a node of a tree in the short form has two, and a pod has a dozen."""

DEEPEST_OBJECT = 2 * DEEPEST
"""Most levels of a whole object. A field begins at most a dozen levels below, so no valid field reaches this depth."""

MOST_VALUES = 10_000
"""Most values in the mappings and lists of a field. A tree of 500 nodes has 4,000, and a pod has some hundred."""


def has_too_many(value: Any, most: int = MOST_VALUES) -> bool:
    """Whether the mappings and lists in a value of JSON have more than ``most`` values together. No more than these are visited."""
    level, count = [value], 0
    while level:
        following: list[Any] = []
        for outer in level:
            count += len(outer)
            if count > most:
                return True
            following += [inner for inner in _inner(outer) if type(inner) in _CONTAINERS]
        level = following
    return False


def is_too_deep(value: Any) -> bool:
    """Whether mappings and lists are nested in a value of JSON more than DEEPEST levels deep."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [inner for outer in level for inner in _inner(outer) if type(inner) in _CONTAINERS]
        if not level:
            return False
    return True


_CONTAINERS = frozenset({dict, list})


def _inner(value: Any) -> Any:
    return value.values() if type(value) is dict else value
