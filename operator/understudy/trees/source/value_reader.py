"""Reads the short YAML form of trees value by value, and collects all problems."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeGuard, TypeVar

from understudy.api.durations import seconds
from understudy.api.ros_names import LONGEST_ROS_NAME, ROS_NAME_PATTERN, ROS_TYPE_PATTERN
from understudy.trees.source.problems import Problem, did_you_mean

DEEPEST = 32
"""Greatest depth of a tree; a reasonable tree has three or four levels."""

MOST = 512
"""Greatest number of nodes in a tree."""

MOST_UNKNOWN = 20
"""Greatest number of unknown keys of a tree, or of one condition of a procedure, that are each a problem. A mapping may have thousands,
and each is compared with the known ones."""

LONGEST = 24 * 3600
"""Longest duration in a tree, in seconds."""

JSON_PREFIX = "json:"
"""The prefix of a value that is JSON (basic_types.h of BehaviorTree.CPP 4.6), which may contain braces."""

Read = Callable[[object], Any]
"""Converts a value of a tree. Raises ValueError with what was found and what would be right."""

Child = TypeVar("Child")

_NODE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,63}")


class Reader:
    """Collects problems; a value with a problem reads as None."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self._nodes = self._unknown_keys = 0

    def problem(self, path: str, message: str) -> None:
        """Note a mistake."""
        self.problems.append(Problem(path, message))

    def is_node(self, value: object, path: str, depth: int, kinds: Sequence[str]) -> TypeGuard[Mapping[str, Any]]:
        """Return whether a value can be read as one more node of one of these kinds; note a problem if it cannot."""
        self._nodes += 1
        if self._nodes > MOST:
            if self._nodes == MOST + 1:
                self.problem(path, f"the tree has more than {MOST} nodes")
            return False
        if depth > DEEPEST:
            self.problem(path, f"the tree is more than {DEEPEST} levels deep")
            return False
        if not isinstance(value, Mapping):
            self.problem(path, f"found {found_text(value)}; a node is a mapping with one of {', '.join(kinds)}")
            return False
        return True

    def kind(self, value: Mapping[str, Any], path: str, kinds: Sequence[str]) -> str | None:
        """Return which of these kinds a node is; note a problem if it is none or several."""
        found = [kind for kind in kinds if kind in value]
        if len(found) > 1:
            self.problem(path, f"found {' and '.join(found)} in one node; give each a node of its own")
            return None
        if not found:
            if not any(key != "name" for key in value):
                self.problem(path, f"the node is empty; give one of {', '.join(kinds)}")
            return None
        return found[0]

    def children(
        self, kind: str, value: object, path: str, read: Callable[[object, str], Child | None]
    ) -> list[Child] | None:
        """Return what ``read`` makes of each node in the list of a composite, and of its path; None if one has a problem."""
        if not isinstance(value, list):
            self.problem(path, f"found {found_text(value)}; {kind!r} must have a list of nodes")
            return None
        if not value:
            self.problem(path, f"the list is empty; {kind} needs at least one node")
            return None
        found = [read(child, f"{path}[{i}]") for i, child in enumerate(value)]
        children = [child for child in found if child is not None]
        return children if len(children) == len(found) else None

    def name(self, value: Mapping[str, Any], path: str) -> str | None:
        """Return the name of a node, if it has one."""
        if "name" not in value:
            return None
        name = value["name"]
        if not isinstance(name, str) or not _NODE_NAME.fullmatch(name):
            self.problem(
                f"{path}.name", f"found {found_text(name)}; a node's name is 1 to 63 letters, digits, '_', '-' and '.'"
            )
            return None
        return name

    def known(self, value: Mapping[str, Any], keys: Iterable[str], path: str) -> None:
        """Note unknown keys as problems."""
        keys = tuple(keys)
        for key in self.unknown(value, keys, path):
            self.problem(f"{path}.{key}", f"unknown key {key!r}{did_you_mean(key, keys)}")

    def unknown(self, value: Mapping[str, Any], known: Collection[str], path: str) -> Iterator[str]:
        """Yield the unknown keys of a mapping, as long as the tree has not too many; note a problem if it has."""
        for key in value:
            if key in known:
                continue
            self._unknown_keys += 1
            if self._unknown_keys <= MOST_UNKNOWN:
                yield str(key)
            elif self._unknown_keys == MOST_UNKNOWN + 1:
                self.problem(path, f"the tree has more than {MOST_UNKNOWN} unknown keys")

    def optional(self, value: Mapping[str, Any], key: str, path: str, read: Read) -> Any:
        """Return a value as ``read`` converts it; None if the key is missing, or if there is a problem."""
        if key not in value:
            return None
        try:
            return read(value[key])
        except ValueError as error:
            self.problem(f"{path}.{key}", str(error))
            return None


def name_of(what: str, example: str) -> Callable[[object], str]:
    """Return a function that reads the fully qualified name of a topic, a node or another part of the ROS graph. It
    raises ValueError."""
    read = _matching(ROS_NAME_PATTERN, f"a fully qualified {what} name such as {example}")

    def read_short(found: object) -> str:
        name = read(found)
        if len(name) > LONGEST_ROS_NAME:
            raise ValueError(f"found {found_text(name)}; a name may have {LONGEST_ROS_NAME} characters")
        return name

    return read_short


def type_of(kind: str, right: str = "") -> Callable[[object], str]:
    """Return a function that reads the type of an interface of a kind: ``msg``, ``srv`` or ``action``. It raises
    ValueError."""
    return _matching(ROS_TYPE_PATTERN.replace("(msg|srv|action)", kind), right or f"package/{kind}/Name")


def _matching(pattern: str, right: str) -> Callable[[object], str]:
    def read(found: object) -> str:
        if isinstance(found, str) and re.fullmatch(pattern, found):
            return found
        if isinstance(found, str) and re.fullmatch(pattern, f"/{found}"):
            raise ValueError(f"found {found_text(found)}; did you mean '/{found}'?")
        raise ValueError(f"found {found_text(found)}; give {right}")

    return read


def word_of(known: Sequence[str]) -> Callable[[object], str]:
    """Return a function that reads one of some words. It raises ValueError."""

    def read(found: object) -> str:
        if found in known:
            return str(found)
        hint = f"; known are {', '.join(known)}"
        if isinstance(found, str):
            hint = did_you_mean(found.upper() if known[0].isupper() else found, known)
        raise ValueError(f"found {found_text(found)}{hint}")

    return read


def number_of(found: object) -> float:
    """Return a number, also if it is written as text, as in XML; NaN if it is none."""
    try:
        return math.nan if isinstance(found, bool) or not isinstance(found, int | float | str) else float(found)
    except (ValueError, OverflowError):
        return math.nan


def duration_of(value: object) -> float:
    """Return the seconds of a duration such as ``500ms``. Raises ValueError."""
    if not isinstance(value, str):
        raise ValueError(f"found {found_text(value)}, which has no unit; write it with ms, s, m or h, such as 500ms")
    length = seconds(value)
    if length <= 0:
        raise ValueError(f"found {found_text(value)}; it must be longer than 0")
    if length > LONGEST:
        raise ValueError(f"found {found_text(value)}; it must be at most {LONGEST // 3600}h")
    return length


def whole_number_of(most: int, *, least: int = 1) -> Callable[[object], int]:
    """Return a function that reads a whole number from ``least`` to ``most``, also if it is written as text, as in XML.
    It raises ValueError."""

    def read(found: object) -> int:
        digits = isinstance(found, str) and found.isascii() and found.isdigit() and len(found) < 10
        number = int(found) if digits and isinstance(found, str) else found
        if not isinstance(number, int) or isinstance(number, bool) or not least <= number <= most:
            raise ValueError(f"found {found_text(found)}; give a whole number from {least} to {most}")
        return number

    return read


def found_text(value: object) -> str:
    """Describe a value for a message."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, int) and abs(value) >= 10**60:  # Python refuses to write one with thousands of digits
        return "a number with more than 60 digits"
    text = repr(value[:61] if isinstance(value, str) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."
