"""Whether the trees of an object are texts that take long to read, and that the operator has not accepted.

The operator has another process read every tree, and ends it after a few seconds. The monitor reads trees itself, and follows
nothing else meanwhile. So it waits for the operator's verdict about long texts, and does not read those that were refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from understudy.api.nesting import DEEPEST
from understudy.kube.client import Object
from understudy.trees.languages.notations import TEXTS
from understudy.trees.languages.tree_check import INVALID, TOO_COSTLY

LONG = 3000
"""Characters of all texts of an object together that are read within 50 ms in every language."""


def unaccepted(item: Object) -> bool:
    """Return whether the object has long trees as texts that the operator has not judged yet, or has refused."""
    if sum(map(len, _texts(item.get("spec"), DEEPEST))) <= LONG:
        return False
    status = item.get("status") or {}
    if status.get("observedGeneration") != item["metadata"].get("generation"):
        return True
    reasons = {one.get("reason") for one in status.get("conditions") or [] if one.get("type") == "Accepted"}
    return bool(reasons & {INVALID, TOO_COSTLY})


def _texts(value: Any, levels: int) -> Iterator[str]:
    """Yield the texts in the fields that hold trees."""
    if levels == 0:
        return
    if isinstance(value, dict):
        for name, inner in value.items():
            if name in TEXTS and isinstance(inner, str):
                yield inner
            else:
                yield from _texts(inner, levels - 1)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner, levels - 1)
