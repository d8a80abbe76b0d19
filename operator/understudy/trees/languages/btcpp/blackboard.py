"""Blackboard entries: the constants that a <SubTree> receives. No node of a health tree writes an entry, so all values
are known in advance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from understudy.trees.languages.btcpp.xml_elements import Element
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import JSON_PREFIX, found_text

Board = Mapping[str, str | None]
"""Values by entry; None if one could not be read, which was reported already."""

SAME = "="
"""``{=}`` is the entry with the same name as the port."""


def entry(value: str, port: str) -> str | None:
    """Return the entry that a port's value names; None if it is a plain value. Raises ValueError if only a part of the
    value is an entry."""
    text = value.strip()
    if text.startswith(JSON_PREFIX):
        return None
    inner = text[1:-1].strip() if text.startswith("{") and text.endswith("}") else None
    if inner is not None and "{" not in inner and "}" not in inner:
        return port if inner == SAME else inner
    if ("{" in value or "}" in value) and ":" in value:
        raise ValueError(_mapping(value))
    if "{" in value or "}" in value:
        raise ValueError(f"found {found_text(value)}; a blackboard entry is a whole value, such as {{scan}}")
    return None


def _mapping(value: str) -> str:
    right = 'json:{"data": "hello"}'
    return f"found {found_text(value)}; braces alone are a blackboard entry, and a mapping has json: in front, such as {right}"


def resolve(value: str, port: str, board: Board) -> str | None:
    """Return a port's value; None if the entry that it names could not be read. Raises ValueError if there is no such
    entry."""
    name = entry(value, port)
    if name is None:
        return value
    if name in board:
        return board[name]
    if ":" in name:
        raise ValueError(_mapping(value))
    if not board:
        raise ValueError(
            f"there is no blackboard entry {name!r}: only the attributes of a <SubTree> create entries, inside that subtree"
        )
    raise ValueError(f"there is no blackboard entry {name!r}{did_you_mean(name, board)}")


def autoremap(element: Element) -> bool:
    """Return whether a <SubTree> sees the entries of the tree that contains it. Raises ValueError."""
    value = element.attributes.get("_autoremap", "false")
    if value.lower() not in ("true", "false", "1", "0"):
        raise ValueError(f"found {found_text(value)}; give true or false")
    return value.lower() in ("true", "1")


def used(tree: Element) -> set[str] | None:
    """Return the entries that a <BehaviorTree> reads; None if they cannot be determined, because a tree in it sees all
    of them."""
    found = set()
    for element in _descendants(tree):
        try:
            if autoremap(element):
                return None
        except ValueError:  # reported when the <SubTree> is read
            return None
        for port, value in element.attributes.items():
            try:
                name = entry(value, port)
            except ValueError:  # reported when the value is read
                continue
            if name is not None:
                found.add(name)
    return found


def _descendants(element: Element) -> Iterator[Element]:
    waiting = [*element.children]
    while waiting:
        found = waiting.pop()
        yield found
        waiting += found.children
