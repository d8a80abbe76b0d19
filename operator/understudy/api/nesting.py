"""How deeply values may be nested in the fields that keep unknown content, such as trees and pod templates.

The API server cannot refuse deep values. A structural schema cannot describe values of any depth and limit the depth, and
CEL rules do not see content that no schema describes. It stores up to 10,000 levels, and Python's functions for nested
values end with a RecursionError at a few hundred.
"""

from __future__ import annotations

from typing import Any

DEEPEST = 100
"""Most levels of mappings and lists below a value; a node of a tree in the short form has two, and a pod has a dozen."""

DEEPEST_OBJECT = 2 * DEEPEST
"""Most levels of a whole object. A field begins at most a dozen levels below, so no valid field reaches this depth."""


def is_too_deep(value: Any, deepest: int = DEEPEST) -> bool:
    """Whether mappings and lists are nested in a value of JSON more than ``deepest`` levels deep."""
    level = [value]
    for _ in range(deepest + 1):
        level = [inner for outer in level for inner in _inner(outer) if type(inner) in _CONTAINERS]
        if not level:
            return False
    return True


_CONTAINERS = frozenset({dict, list})


def _inner(value: Any) -> Any:
    return value.values() if type(value) is dict else value
