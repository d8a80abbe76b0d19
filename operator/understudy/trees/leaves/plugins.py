"""Finds leaves of other installed packages through entry points (docs/how-to/writing-a-leaf.md)."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from itertools import groupby

from understudy.trees.leaves.custom_leaf import kind_of
from understudy.trees.leaves.leaf_plan import LeafKind

_logger = logging.getLogger(__name__)

GROUP = "understudy.leaves"
"""The group of entry points. Each one maps a leaf's key in the short form to the class that judges."""

_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)+")


@dataclass(frozen=True)
class PluginLeaves:
    """The leaves that were found."""

    leaves: Mapping[str, LeafKind]
    """Usable leaves by their keys in the short form."""
    refused: Mapping[str, str]
    """Unusable leaves, and why."""


def load_plugins(taken: Collection[str]) -> PluginLeaves:
    """Load the leaves of all installed packages. None can have a name that is ``taken``.

    A leaf that cannot be used is logged, and reported if a tree names it. Robots whose trees do not name it stay
    protected.
    """
    leaves: dict[str, LeafKind] = {}
    refused: dict[str, str] = {}
    found = sorted(entry_points(group=GROUP), key=lambda one: (one.name, _package(one)))
    for name, several in groupby(found, key=lambda one: one.name):
        entries = list(several)
        try:
            leaves[name] = _leaf(name, entries, taken)
        except ValueError as error:
            refused[name] = f"{name} of {' and '.join(map(_package, entries))} cannot be used: {error}"
            _logger.error("%s", refused[name])
    return PluginLeaves(leaves, refused)


def _leaf(name: str, entries: list[EntryPoint], taken: Collection[str]) -> LeafKind:
    """Load the leaf of a name. Raises ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError("its name must be two words at least, such as acme_lively: a-z and 0-9, with _ between them")
    if name in taken:
        raise ValueError("Understudy uses that name itself; give it another one")
    if len(entries) > 1:
        raise ValueError("several packages have a leaf of that name; install only one")
    try:
        judge = entries[0].load()
    except Exception as error:  # a package may raise anything during its import
        raise ValueError(f"{entries[0].value} cannot be loaded, {type(error).__name__}: {error!s:.200}") from error
    return kind_of(name, judge)


def _package(entry: EntryPoint) -> str:
    """Return the name and version of its package, such as ``acme-leaves 1.0``."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "a package without a name"
