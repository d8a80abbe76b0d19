"""Loads procedures and checks in all of their notations.

The component that reads a tree from the API converts it into the short form, so that agents need to know only that.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.trees.languages.btcpp import loader as btcpp
from understudy.trees.languages.btcpp import steps as xml
from understudy.trees.languages.notations import TEXTS
from understudy.trees.languages.osc import loader as osc
from understudy.trees.languages.osc import steps as scenarios
from understudy.trees.languages.short.procedure_loader import ProcedureTree, load_check, load_procedure
from understudy.trees.languages.text import loader as text_loader
from understudy.trees.languages.text.source_map import SourceMap
from understudy.trees.source.positions import WHOLE_FILE, TextOffset

_PROCEDURES = {
    "xml": (btcpp.reader(xml.PROCEDURES), btcpp.CALLED),
    "osc": (osc.reader(scenarios.PROCEDURES), osc.CALLED),
}
_CHECKS = {"xml": (btcpp.reader(xml.CHECKS), btcpp.CALLED), "osc": (osc.reader(scenarios.CHECKS), osc.CALLED)}


@dataclass(frozen=True)
class LoadedProcedure:
    """A procedure or check in the short form, with the tree that it loads into."""

    node: Mapping[str, Any]
    """In the short form."""
    tree: ProcedureTree
    places: Mapping[str, str] = field(default_factory=dict)
    """By path in the short form, the position of each node in its text; empty if it was written in the short form."""


def compose(form: str, tree: Any, *, check: bool, path: str, begins: TextOffset = WHOLE_FILE) -> LoadedProcedure:
    """Load a procedure or, with ``check``, a check in the notation ``form``, which is its field.

    Problems are reported with ``path``. Their lines and columns are those of the file in which a text ``begins``.
    Raises TreeError with all problems.
    """
    load = load_check if check else load_procedure
    if form not in TEXTS:
        return LoadedProcedure(tree, load(tree, path=path))

    def loaded(node: dict[str, Any], source: SourceMap) -> LoadedProcedure:
        places = {inner: f"{origin.place}: {origin.label}" for inner, origin in source.nodes.items()}
        return LoadedProcedure(node, load(node, path=path, places=places), places)

    read, called = (_CHECKS if check else _PROCEDURES)[form]
    return text_loader.load_translated(tree, read, loaded, called=called, path=path, begins=begins)


def composed(procedure: Procedure | Check, *, path: str) -> LoadedProcedure:
    """Return the procedure of a spec, which is loaded only once; ``path`` as in :func:`compose`. Raises TreeError with
    all problems."""
    return _composed(procedure.form, json.dumps(procedure.tree), isinstance(procedure, Check), path)


@lru_cache(maxsize=256)
def _composed(form: str, tree: str, check: bool, path: str) -> LoadedProcedure:
    return compose(form, json.loads(tree), check=check, path=path)
