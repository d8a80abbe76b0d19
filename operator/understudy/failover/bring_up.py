"""The procedure of a workload, a policy or a pool that prepares an instance to drive the robot."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from understudy.api.base import seconds
from understudy.api.kinds.procedure_spec import Procedure
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.problems import TreeError


@dataclass(frozen=True)
class BringUp:
    """A procedure, with its name in messages."""

    name: str
    """Such as bringUp, recovery or initialization."""
    tree: Mapping[str, Any]
    """In the short form."""
    within: float
    """Seconds."""
    digest: str
    """Identifies the procedure, whichever language it is written in."""
    restores_state: bool
    """Whether the tree itself contains the step that restores kept state."""
    places: Mapping[str, str] = field(default_factory=dict)
    """The position of each node in the text, if the procedure was written in another language."""
    problem: str = ""
    """Why it cannot be run. Empty if it can."""

    @classmethod
    def of(cls, name: str, procedure: Procedure | None) -> BringUp | None:
        """Convert a procedure of a spec. Returns None if there is no procedure."""
        if procedure is None:
            return None
        tree = json.dumps(procedure.tree, sort_keys=True)
        return _known(name, procedure.form, tree, seconds(procedure.within))


@lru_cache(maxsize=64)
def _known(name: str, form: str, tree: str, within: float) -> BringUp:
    """Load a procedure. Cached, because callers ask every second and loading a tree takes time."""
    try:
        found = compose(form, json.loads(tree), check=False, path=name)
    except TreeError as error:
        return BringUp(name, {}, within, _digest(tree), False, problem=error.in_short())
    digest = _digest(json.dumps(found.node, sort_keys=True))
    return BringUp(name, found.node, within, digest, found.tree.restores_state, found.places)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]
