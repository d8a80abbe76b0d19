"""Snapshots of a health tree as plain values, for terminals, web pages and tools."""

from __future__ import annotations

from typing import Any, Literal

from py_trees.behaviour import Behaviour
from py_trees.composites import Parallel, Sequence
from py_trees.decorators import Inverter

from understudy.trees.core.composites import AnyOf
from understudy.trees.core.health_tree import HealthTree
from understudy.trees.core.leaf import STATE, Leaf, State
from understudy.trees.core.observations import Observations
from understudy.trees.core.task_activity import While

Shown = State | Literal["Idle", "Unasked"]
"""The displayed state of a node. Idle: the node's task is not active. Unasked: an earlier node of its sequence does not
hold."""

Snapshot = dict[str, Any]
"""A node: ``name``, ``kind``, ``state`` and ``reason``. A leaf also has its ``topic`` and, if its messages are
received, the number ``received`` so far and the ``age`` of the last one in seconds. A composite has ``children``."""

_KINDS: tuple[tuple[type[Behaviour], str], ...] = (
    (While, "while"),
    (Parallel, "parallel"),
    (Sequence, "sequence"),
    (AnyOf, "selector"),
    (Inverter, "inverter"),
)


def snapshot(tree: HealthTree, observations: Observations, now: float) -> Snapshot | None:
    """Return the tree with the states of its last evaluation; None if no part of it can be evaluated. ``now`` in Unix
    seconds."""
    return _node(tree.root, observations, now) if tree.root is not None else None


def states(tree: HealthTree) -> tuple[Shown, ...]:
    """Return the state of each node at the last evaluation. It costs a tenth of a snapshot."""
    return tuple(shown(node) for node in tree.root.iterate()) if tree.root is not None else ()


def shown(node: Behaviour) -> Shown:
    """Return the state of a node at the last evaluation."""
    if node.status not in STATE:
        return "Unasked"
    if isinstance(node, Leaf | While) and not node.counts():
        return "Idle"
    return STATE[node.status]


def _node(node: Behaviour, observations: Observations, now: float) -> Snapshot:
    state = shown(node)
    if isinstance(node, Leaf):
        return _leaf(node, state, observations, now)
    found: Snapshot = {"name": node.name, "kind": _kind(node), "state": state, "reason": ""}
    if isinstance(node, While):
        found["task"] = node.task.action
    found["children"] = [_node(child, observations, now) for child in node.children]
    return found


def _leaf(leaf: Leaf, state: Shown, observations: Observations, now: float) -> Snapshot:
    reason = leaf.feedback_message if state in ("Failed", "Starting") else ""
    found: Snapshot = {"name": leaf.name, "kind": _kind(leaf), "state": state, "reason": reason, "topic": leaf.topic}
    record = observations.topic(leaf.topic) if leaf.uses_messages else None
    if record is not None:
        found["received"] = record.count
        found["age"] = round(max(0.0, now - record.last), 3) if record.last is not None else None
    return found


def _kind(node: Behaviour) -> str:
    """Return the key of the node in the short form."""
    if isinstance(node, Leaf):
        return node.kind
    return next((name for kind, name in _KINDS if isinstance(node, kind)), type(node).__name__.lower())
