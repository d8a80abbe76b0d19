"""A snapshot of a health tree in the form of py_trees_ros: a list of behaviours that refer to each other by id.

Plain values; the numbers are those of py_trees_ros_interfaces/msg/Behaviour 2.1. A tool builds its own tree from them.
It fails for an unknown type or status, a decorator without a child, and a list without a root, so none of these is ever
sent.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from understudy.trees.core.snapshots import Snapshot

INVALID, RUNNING, SUCCESS, FAILURE = 1, 2, 3, 4
BEHAVIOUR, SEQUENCE, SELECTOR, PARALLEL, DECORATOR = 1, 2, 3, 4, 6

NOBODY = bytes(16)
"""The id that means none."""

_TYPES: Mapping[str, int] = {
    "parallel": PARALLEL,
    "sequence": SEQUENCE,
    "selector": SELECTOR,
    "while": DECORATOR,
    "inverter": DECORATOR,
}
_STATUSES: Mapping[str, int] = {
    "Healthy": SUCCESS,
    "Starting": RUNNING,
    "Failed": FAILURE,
    "Idle": INVALID,
    "Unasked": INVALID,
}
_IDS = uuid.uuid5(uuid.NAMESPACE_DNS, "understudy.dev")
_NOTHING: Snapshot = {
    "name": "health",
    "kind": "tree",
    "state": "Unasked",
    "reason": "none of its topics can be watched",
}


class Behaviour(NamedTuple):
    """One node of the tree."""

    id: bytes
    parent: bytes
    children: tuple[bytes, ...]
    current: bytes
    """Of a composite: the child that decided its state."""
    tip: bytes
    """The node below it that decided its state; NOBODY for a leaf."""
    name: str
    kind: str
    """Its key in the short form."""
    type: int
    detail: str
    status: int
    message: str
    active: bool
    """Whether it was judged at the last evaluation."""


def behaviours(tree: Snapshot | None, workload: str) -> list[Behaviour]:
    """Return the nodes of a snapshot depth first, parents before their children.

    A node's id depends on its place, kind and name only, so it stays the same after a restart of the monitor.
    """
    found: list[Behaviour] = []
    _list(tree if tree is not None else _NOTHING, f"{workload}:", NOBODY, False, found)
    return found


def statuses(listed: Sequence[Behaviour]) -> tuple[tuple[bytes, int, bool], ...]:
    """Return the ids, states and activity of the nodes. A difference counts as a change; messages do not count."""
    return tuple((node.id, node.status, node.active) for node in listed)


def _list(node: Snapshot, place: str, parent: bytes, idle: bool, found: list[Behaviour]) -> Behaviour:
    kind, state, children = node["kind"], node["state"], node.get("children", ())
    waits = kind == "while" and state == "Idle"
    own = _id(f"{place}/{kind}/{node['name']}")
    index = len(found)
    found.append(_PLACE)
    below = [_list(child, f"{place}/{i}", own, idle or waits, found) for i, child in enumerate(children)]
    current = below[_deciding(kind, below)] if below else None
    status, message = _STATUSES.get(state, RUNNING), node["reason"]
    if waits:
        # The node holds, and its children are not evaluated.
        status, message = SUCCESS, f"no goal of {node['task']} is active"
    if idle:
        status, message = INVALID, ""
    type_ = _TYPES.get(kind, BEHAVIOUR)
    found[index] = made = Behaviour(
        id=own,
        parent=parent,
        children=tuple(child.id for child in below),
        current=current.id if current is not None and type_ != DECORATOR else NOBODY,
        tip=NOBODY if current is None else current.id if current.tip == NOBODY else current.tip,
        name=node["name"],
        kind=kind,
        type=type_,
        detail="all of them" if type_ == PARALLEL else f"while {node['task']} is active" if "task" in node else "",
        status=status,
        message=message,
        active=status != INVALID,
    )
    return made


_PLACE = Behaviour(NOBODY, NOBODY, (), NOBODY, NOBODY, "", "", 0, "", 0, "", False)
"""Keeps a node's place in the list until its children are known."""


def _deciding(kind: str, children: Sequence[Behaviour]) -> int:
    """Return which child gave a node its state."""
    order = {"parallel": (FAILURE, RUNNING), "sequence": (FAILURE, RUNNING), "selector": (SUCCESS, RUNNING)}.get(
        kind, ()
    )
    for status in order:
        for index, child in enumerate(children):
            if child.status == status:
                return index
    return len(children) - 1


@lru_cache(maxsize=1024)
def _id(place: str) -> bytes:
    """Build an id. It has the bits of a version 4 UUID, because tools read ids as that version and would change any
    other."""
    return uuid.UUID(bytes=uuid.uuid5(_IDS, place).bytes, version=4).bytes
