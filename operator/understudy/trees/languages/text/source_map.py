"""Converts the parsed nodes of a text into the short form, and maps each part to its position in the text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from understudy.api.durations import LONGEST_TEXT
from understudy.trees.source.positions import nearest
from understudy.trees.source.problems import Problem, TreeError

LONGEST_MESSAGE = 500
"""Most characters of a message; some quote what was found."""

MOST_PROBLEMS = 100
"""Number of problems after which the search ends: a problem in a subtree is found at each of its uses."""

MOST_IN_VALUES = 2 * LONGEST_TEXT
"""Most characters of all values of a tree. A text is bounded, but each use of a subtree repeats the values in it."""

_TOO_LONG = (
    f"the values of the tree have more than {MOST_IN_VALUES} characters; shorten them, or use subtrees less often"
)

WRAPPED: Mapping[str, str] = {"while": "do", "inverter": "inverter", "timeout": "timeout.do", "retry": "retry.do"}
"""By kind of a wrapping node, the path from it to the wrapped node."""


@dataclass(frozen=True)
class LocatedProblem:
    """A problem and its position. Problems are sorted by position."""

    line: int
    column: int
    problem: Problem


@dataclass(frozen=True)
class Origin:
    """The source of a node in the text."""

    label: str
    """A name for messages, such as ``<Topic>`` or ``topic()``."""
    line: int
    column: int
    uses: tuple[int, ...] = ()
    """The lines of the nodes that use the subtrees through which it is in the tree, the outermost first."""

    @property
    def place(self) -> str:
        """Its position in words, such as ``line 7, column 5``."""
        by = f" (used in line {', '.join(map(str, self.uses))})" if self.uses else ""
        return f"line {self.line}, column {self.column}{by}"

    def problem(self, path: str, message: str, attribute: str = "") -> LocatedProblem:
        """Return a problem at this position, or with one of its attributes."""
        what = f"{self.label} {attribute:.60}" if attribute else self.label
        return LocatedProblem(
            self.line, self.column, Problem(f"{path}, {self.place}", f"{what}: {message:.{LONGEST_MESSAGE}}")
        )


@dataclass(frozen=True)
class ParsedNode:
    """A node with those of its values and children that could be read."""

    origin: Origin
    key: str
    """Its key in the short form."""
    name: str | None
    ports: Mapping[str, str] = field(default_factory=dict)
    """By port, the path of its value in the short form."""
    values: Mapping[str, str] = field(default_factory=dict)
    """By port, the given value."""
    children: list[ParsedNode] = field(default_factory=list)
    places: Mapping[str, Origin] = field(default_factory=dict)
    """By port, the position of its value, if that is known more exactly than by the node."""
    reads: Mapping[str, Callable[[str], Any]] = field(default_factory=dict)
    """By port, the parser of its value, if that is not a text in the short form. Raises ValueError."""


class SourceMap:
    """Maps problems with the short form to their positions in the text."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._places: dict[str, tuple[Origin, str]] = {}
        self._unread: set[str] = set()
        self._in_values = 0
        self.nodes: dict[str, Origin] = {}
        """By path from the tree, including the node's kind, the origin of each node."""
        self.problems: list[LocatedProblem] = []
        """Values that cannot be read."""

    def short_form(self, written: ParsedNode) -> dict[str, Any]:
        """Return the node in the short form, and note the positions of everything in it."""
        return self._node(written, self._path)

    def called(self, path: str) -> str:
        """Return the name of another node for messages."""
        origin, _ = self._find(path)
        return f"{origin.label} in {origin.place}"

    def problem(self, found: Problem) -> LocatedProblem:
        """Convert a problem with the short form into one with the text."""
        origin, port = self._find(found.path)
        return origin.problem(self._path, found.message, port)

    def is_reported(self, found: Problem) -> bool:
        """Return whether a problem concerns a value that could not be read, which was reported already."""
        return found.path in self._unread

    def _node(self, written: ParsedNode, path: str) -> dict[str, Any]:
        self._places[path] = (written.origin, "")
        self.nodes[f"{path}.{written.key}".removeprefix(f"{self._path}.")] = written.origin
        self._places[f"{path}.name"] = (written.places.get("name", written.origin), "name")
        node: dict[str, Any] = {"name": written.name} if written.name is not None else {}
        for port, where in written.ports.items():
            self._places[f"{path}.{where}"] = (written.places.get(port, written.origin), port)
            *above, last = where.split(".")
            inner = node
            for key in above:
                inner = inner.setdefault(key, {})
            if port in written.values:
                inner[last] = self._value(written, port, f"{path}.{where}")
        if written.key in WRAPPED:
            *above, last = WRAPPED[written.key].split(".")
            inner = node
            for key in above:
                inner = inner.setdefault(key, {})
            inner[last] = self._node(written.children[0], f"{path}.{WRAPPED[written.key]}")
        elif written.children:
            node[written.key] = [
                self._node(child, f"{path}.{written.key}[{index}]") for index, child in enumerate(written.children)
            ]
        else:
            node.setdefault(written.key, {})  # a leaf without any value
        return node

    def _value(self, written: ParsedNode, port: str, path: str) -> Any:
        text = written.values[port]
        before, self._in_values = self._in_values, self._in_values + len(text)
        if self._in_values > MOST_IN_VALUES:
            self._unread.add(path)
            if before <= MOST_IN_VALUES:
                origin = written.places.get(port, written.origin)
                self.problems.append(origin.problem(self._path, _TOO_LONG, port))
            return ""
        try:
            return written.reads[port](text) if port in written.reads else text
        except ValueError as error:
            self._unread.add(path)
            self.problems.append(written.places.get(port, written.origin).problem(self._path, str(error), port))
            return text

    def _find(self, path: str) -> tuple[Origin, str]:
        return nearest(self._places, path) or self._places[self._path]


def refusal(found: Iterable[LocatedProblem], path: str) -> TreeError:
    """Return the error of a text with these problems, in the order of the text."""
    # A subtree that is used twice reports its problems once.
    listed = sorted(dict.fromkeys(found), key=lambda one: (one.line, one.column))
    problems = [one.problem for one in listed[:MOST_PROBLEMS]]
    if len(listed) > MOST_PROBLEMS:
        problems.append(Problem(path, f"and {len(listed) - MOST_PROBLEMS} more"))
    return TreeError(problems)
