"""What is done to an instance on its way to driving: a procedure of the workload's, the policy's or a pool's."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from understudy.api.base import seconds
from understudy.api.procedures import Procedure
from understudy.trees.problems import TreeError
from understudy.trees.procedures import load_procedure


@dataclass(frozen=True)
class BringUp:
    """A procedure, and what messages call it."""

    name: str
    """Such as bringUp, recovery or initialization."""
    tree: Mapping[str, Any]
    within: float
    """Seconds."""
    digest: str
    """Tells it from every other one."""
    restores_state: bool
    """Whether the tree says itself where kept state is restored."""

    @classmethod
    def of(cls, name: str, procedure: Procedure | None) -> BringUp | None:
        """From a spec; None where there is none."""
        if procedure is None:
            return None
        return _known(name, json.dumps(procedure.yaml, sort_keys=True), seconds(procedure.within))


@lru_cache(maxsize=64)
def _known(name: str, tree: str, within: float) -> BringUp:
    """Asked for every second, and loading a tree takes a while."""
    found: dict[str, Any] = json.loads(tree)
    try:
        restores = load_procedure(found, path=name).restores_state
    except TreeError:
        restores = False  # the agent refuses it, and says why
    return BringUp(name, found, within, hashlib.sha256(tree.encode()).hexdigest()[:12], restores)
