"""Reads values with fields, such as a request, for languages that have only texts: in the flow style of YAML, or as
JSON.

JSON has the prefix ``json:``, as in BehaviorTree.CPP, in which braces alone are a blackboard entry.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any, NoReturn

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from understudy.trees.source.value_reader import JSON_PREFIX, found_text
from understudy.trees.source.yaml_scalars import (
    HALF_CHARACTER,
    TAG,
    Loader,
    has_half_character,
    plain,
    refusal,
    whole_json,
)

LONGEST = 16384
"""Most characters of one value."""

DEEPEST = 32
"""Greatest depth of nested mappings and lists; ROS' own messages have five or six levels."""


def structure_of(text: str) -> Any:
    """Parse a text into a mapping, a list, a number, a boolean or a text. Raises ValueError."""
    if len(text) > LONGEST:
        raise ValueError(f"has {len(text)} characters; it may have {LONGEST}")
    stripped = text.strip()
    try:
        if stripped.startswith(JSON_PREFIX):
            return _checked(_json(stripped.removeprefix(JSON_PREFIX)), 0)
        return _checked(_yaml(stripped), 0)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


_POWER = re.compile(r"-?[0-9]+[eE][-+]?[0-9]+")
_TOO_DEEP = f"is nested too deeply; it may be {DEEPEST} deep"


def _checked(value: Any, depth: int) -> Any:
    """Return the value if JSON can express it. Raises ValueError."""
    if depth > DEEPEST:
        raise ValueError(_TOO_DEEP)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"found {value}; give a number")
    if isinstance(value, str) and has_half_character(value):
        raise ValueError(HALF_CHARACTER)
    if isinstance(value, dict) and any(map(has_half_character, value)):
        raise ValueError(f"has a key that {HALF_CHARACTER}")
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _checked(inner, depth + 1)
    return value


# -- JSON -------------------------------------------------------------------------------------------------------------


def _json(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_once, parse_int=whole_json, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        message = f"found {found_text(text)}, which is not JSON: {error.msg} at character {error.pos + 1}"
        raise ValueError(f'{message}; write it as in json:{{"data": "hello"}}') from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{key!r:.60} is given twice; remove one of them")
        found[key] = value
    return found


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"found {word}; give a number")


# -- YAML -------------------------------------------------------------------------------------------------------------


def _yaml(text: str) -> Any:
    try:
        node = yaml.compose(text, Loader=Loader)
    except yaml.MarkedYAMLError as error:
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        raise ValueError(
            f"found {found_text(text)}, which is not YAML: {problem:.200}; write it as in {{data: hello}}"
        ) from error
    except yaml.reader.ReaderError as error:
        raise ValueError(
            f"found the character {chr(error.character)!a}, which YAML does not take; remove it"
        ) from error
    return _value(node, set()) if node is not None else None


def _value(node: Node, visited: set[int]) -> Any:
    # Repeated references could make a small text into a value without end.
    if id(node) in visited:
        raise ValueError("has an alias (*) in it; write out what it stands for")
    visited.add(id(node))
    if isinstance(node, ScalarNode):
        if problem := refusal(node):
            raise ValueError(problem)
        # A number of JSON, which YAML 1.1 reads as a number only with a decimal point.
        return float(node.value) if node.style is None and _POWER.fullmatch(node.value) else plain(node)
    if node.tag != (f"{TAG}map" if isinstance(node, MappingNode) else f"{TAG}seq"):
        raise ValueError(f"found the tag {node.tag.replace(TAG, '!!'):.60}; remove it")
    if isinstance(node, MappingNode):
        return _once(list(_items(node, visited)))
    assert isinstance(node, SequenceNode), "there is no other kind of node"
    return [_value(item, visited) for item in node.value]


def _items(node: MappingNode, visited: set[int]) -> Iterator[tuple[str, Any]]:
    for key, value in node.value:
        if not isinstance(key, ScalarNode):
            raise ValueError("has a key that is not a text; write a text before the ':'")
        # Some fields of messages are called y and n, which YAML 1.1 reads as booleans.
        yield key.value, _value(value, visited)
