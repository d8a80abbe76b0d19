"""All kinds of leaves. A new leaf is a module of this folder and one line here."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.trees.leaves import (
    action_progress,
    age,
    diagnostics,
    lifecycle,
    log,
    motion,
    node,
    parameter,
    pod,
    procedure_leaves,
    publisher,
    topic,
    transform,
    value,
)
from understudy.trees.leaves.leaf_plan import LeafKind
from understudy.trees.leaves.plugins import load_plugins

_OWN: tuple[LeafKind, ...] = (
    topic.TOPIC,
    value.VALUE,
    age.AGE,
    diagnostics.DIAGNOSTICS,
    transform.TRANSFORM,
    publisher.PUBLISHER,
    node.NODE,
    log.LOG,
    action_progress.PROGRESS,
    lifecycle.LIFECYCLE,
    motion.MOTION,
    parameter.PARAMETER,
    pod.POD_LEAF,
)

_WORDS = """
one_of remove_default associated_actor while_task_active sub_tree parallel_all reactive_sequence reactive_fallback
async_sequence async_fallback retry_until_successful
"""

RESERVED = frozenset((*procedure_leaves.STEPS, *procedure_leaves.CONDITIONS, *_WORDS.split()))
"""Names of two or more words that a language already uses. Leaves of other packages have at least two words."""

_ADDED = load_plugins(RESERVED)

PLUGINS: Mapping[str, LeafKind] = _ADDED.leaves
"""The leaves of other installed packages."""

REFUSED_PLUGINS: Mapping[str, str] = _ADDED.refused
"""Why other leaves of such packages cannot be used."""

LEAVES: Mapping[str, LeafKind] = {**{kind.name: kind for kind in _OWN}, **PLUGINS}
"""All kinds of leaves, by their keys in the short form."""
