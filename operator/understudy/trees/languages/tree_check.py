"""Checks one tree of an object in the API. Request and verdict are plain values, so that another process can do it."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from understudy.trees.languages.notations import load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.languages.text_files import load_text
from understudy.trees.source.problems import TreeError

INVALID = "TreeInvalid"
"""Reason of a tree with mistakes."""

TOO_COSTLY = "TreeTooCostly"
"""Reason of a tree whose check takes too long, or takes too much memory."""

LONGEST_TREE = 2**19
"""Most characters of a procedure in the short form, as JSON. A subtree is written once and repeated at each of its uses."""

Purpose = Literal["health", "file", "procedure", "check"]
"""A health tree in the object itself, a health tree in a text of its own, a procedure, or a check."""


@dataclass(frozen=True)
class TreeText:
    """A tree to be checked."""

    purpose: Purpose
    form: str
    """The notation, as the name of the field that holds it."""
    text: str
    """The tree as JSON; of a file, its text."""
    path: str
    """Its place for messages."""
    grace: float = 0.0
    """Seconds within which an instance must become healthy for the first time; only of a health tree."""

    @cached_property
    def digest(self) -> bytes:
        """What identifies it among all trees."""
        hashed = hashlib.sha256(f"{self.purpose} {self.form} {len(self.path)} {self.path} {self.grace} ".encode())
        hashed.update(self.text.encode(errors="surrogatepass"))
        return hashed.digest()


@dataclass(frozen=True)
class Verdict:
    """The result of a check."""

    reason: str = ""
    """Why the tree is refused; empty if it is valid."""
    message: str = ""
    """All problems of a refused tree."""
    tree: str = ""
    """As JSON: a valid procedure in the short form, or a valid tree of a file in the form that ``spec.monitoring`` has."""
    cost: float = 0.0
    """Processor time of the check, in seconds."""


def check(tree: TreeText) -> Verdict:
    """Check a tree."""
    started = time.process_time()
    try:
        found = json.dumps(_loaded(tree), sort_keys=tree.purpose != "file")
    except TreeError as error:
        return Verdict(INVALID, error.in_short(), cost=time.process_time() - started)
    cost = time.process_time() - started
    if len(found) > LONGEST_TREE:
        return too_costly(
            tree, f"in the short form it has {len(found)} characters, and {LONGEST_TREE} are allowed", cost
        )
    return Verdict(tree=found, cost=cost)


def _loaded(tree: TreeText) -> Any:
    """Return what the tree becomes; None if nobody needs that. Raises TreeError."""
    if tree.purpose == "file":
        return load_text(tree.form, tree.text, path=tree.path, grace=tree.grace)
    written = json.loads(tree.text)
    if tree.purpose == "health":
        load_health(tree.form, written, grace=tree.grace, path=tree.path)
        return None
    return compose(tree.form, written, check=tree.purpose == "check", path=tree.path).node


def too_costly(tree: TreeText, why: str, cost: float) -> Verdict:
    """Return the verdict for a tree that is refused by its cost."""
    message = f"{tree.path}: {why}. Use fewer nodes, shorter values, or the same subtree less often"
    return Verdict(TOO_COSTLY, message, cost=cost)
