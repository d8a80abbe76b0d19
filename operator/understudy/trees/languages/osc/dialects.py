"""The part of the language that one kind of tree can use. The dialects of procedures are in steps.py, which agents do
not load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from understudy.trees.languages.osc import library, tokens
from understudy.trees.languages.osc.library import Behavior
from understudy.trees.source import tree_kinds
from understudy.trees.source.tree_kinds import TreeKind


@dataclass(frozen=True, eq=False)
class Dialect:
    """The parts of the language that trees of one kind can have."""

    subject: TreeKind
    actions: Mapping[str, Behavior]
    modifiers: Mapping[str, Behavior]
    refused: Mapping[str, str]
    """Why they cannot have other behaviours, and what to use instead."""
    words: Mapping[str, str]
    """Why they cannot have some words and signs of the language."""
    scenario: str
    """An example of a scenario's name."""
    do: str
    """The usual beginning of a scenario, such as ``do parallel:``."""
    example: str
    """An example of an action."""


HEALTH = Dialect(
    tree_kinds.HEALTH,
    library.ACTIONS,
    library.MODIFIERS,
    library.REFUSED,
    tokens.REFUSED,
    "healthy",
    "do parallel:",
    "topic()",
)
"""Health trees."""
