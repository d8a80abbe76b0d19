"""Rebuilds a tree with py_trees itself from a list of behaviours, by the same rules as the tools of py_trees_ros."""

from __future__ import annotations

import re
import uuid
from collections.abc import Iterable
from typing import NamedTuple

import py_trees
from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy, Status

STATUSES = {1: Status.INVALID, 2: Status.RUNNING, 3: Status.SUCCESS, 4: Status.FAILURE}


class Row(NamedTuple):
    """What of a behaviour tells where it is and how."""

    id: bytes
    parent: bytes
    children: tuple[bytes, ...]
    type: int
    status: int
    name: str
    message: str


def rebuilt(rows: Iterable[Row]) -> Behaviour:
    """The root. Fails where a tool would, or would show another tree."""
    known = {row.id: row for row in rows}
    (root,) = (row for row in known.values() if row.parent == bytes(16))
    ids: list[bytes] = []

    def built(row: Row) -> Behaviour:
        ids.append(row.id)
        assert all(known[child].parent == row.id for child in row.children)
        children = [built(known[child]) for child in row.children]
        match row.type:
            case 2:
                node = py_trees.composites.Sequence(row.name, memory=False, children=children)
            case 3:
                node = py_trees.composites.Selector(row.name, memory=False, children=children)
            case 4:
                node = py_trees.composites.Parallel(row.name, policy=ParallelPolicy.SuccessOnAll(), children=children)
            case 6:
                (child,) = children
                node = py_trees.decorators.PassThrough(row.name, child)
            case 1:
                assert not children
                node = py_trees.behaviours.Dummy(row.name)
            case other:
                raise AssertionError(f"no tool knows type {other}")
        node.id = uuid.UUID(bytes=row.id, version=4)
        assert node.id.bytes == row.id, "tools read every id as one of version 4"
        node.status, node.feedback_message = STATUSES[row.status], row.message
        return node

    tree = built(root)
    assert sorted(ids) == sorted(known), "all of it hangs together"
    return tree


def drawn(root: Behaviour) -> list[str]:
    """As py_trees draws it on a terminal, without the colours."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", py_trees.display.unicode_tree(root, show_status=True))
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]
