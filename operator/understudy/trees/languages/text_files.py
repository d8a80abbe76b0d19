"""Loads a health tree from a text of its own, such as a key of a ConfigMap. Problems have their line and column."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from understudy.api.durations import LONGEST_TEXT
from understudy.api.nesting import DEEPEST
from understudy.trees.languages.notations import load_health
from understudy.trees.source.positions import WHOLE_FILE, TextOffset, nearest
from understudy.trees.source.problems import Problem, TreeError
from understudy.trees.source.yaml_scalars import TAG, Loader, plain, refusal


def load_text(form: str, text: str, *, path: str, grace: float, begins: TextOffset = WHOLE_FILE) -> Any:
    """Load a tree to check it, and return it in the form that ``spec.monitoring`` has.

    Problems are reported with ``path``; ``grace`` is in seconds. Lines and columns are those of the file in which the
    text ``begins``. Raises TreeError with all problems.
    """
    if len(text) > LONGEST_TEXT:
        raise TreeError([Problem(path, f"has {len(text)} characters; a tree may have {LONGEST_TEXT}")])
    if form != "yaml":
        load_health(form, text, grace=grace, path=path, begins=begins)
        return text
    read = _Read(text, path, begins)
    try:
        load_health(form, read.tree, grace=grace, path=path)
    except TreeError as error:
        raise TreeError([read.placed(problem) for problem in error.problems]) from error
    return read.tree


class _Place(NamedTuple):
    line: int
    column: int


class _Read:
    """Reads a text into a node of the short form, and records all positions. Raises TreeError."""

    def __init__(self, text: str, path: str, begins: TextOffset) -> None:
        self._path, self._begins = path, begins
        self._places: dict[str, _Place] = {}
        self._visited: set[int] = set()
        self._problems: list[Problem] = []
        self.tree = self._value(self._document(text), "", 0)
        if self._problems:
            raise TreeError(self._problems)

    def placed(self, problem: Problem) -> Problem:
        """Return a problem with the short form, with its position in the text."""
        inner = problem.path.removeprefix(self._path)
        return self._problem_at(nearest(self._places, inner) or _Place(1, 1), inner, problem.message)

    def _problem_at(self, place: _Place, inner: str, message: str) -> Problem:
        text = f"{inner.removeprefix('.')}: {message}" if inner else message
        return Problem(f"{self._path}, line {place.line}, column {place.column}", text)

    def _document(self, text: str) -> Node:
        try:
            node = yaml.compose(text, Loader=Loader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            place = self._at(mark.line, mark.column) if mark else self._at(0, 0)
            problem = ", ".join(part for part in (error.context, error.problem) if part)
            raise TreeError(
                [self._problem_at(place, "", f"this is not YAML: {problem:.200}; correct it here")]
            ) from error
        except yaml.reader.ReaderError as error:
            before = text[: error.position]
            place = self._at(before.count("\n"), len(before) - before.rfind("\n") - 1)
            message = f"found the character {chr(error.character)!a}, which YAML does not take; remove it"
            raise TreeError([self._problem_at(place, "", message)]) from error
        except RecursionError as error:
            raise TreeError([Problem(self._path, f"is nested too deeply; it may be {DEEPEST} deep")]) from error
        if node is None:
            raise TreeError([Problem(self._path, "there is nothing in it; give a node such as parallel")])
        return node

    def _at(self, line: int, column: int) -> _Place:
        """Convert a position of the text into one of the file."""
        return _Place(line + 1 + self._begins.lines, column + 1 + self._begins.columns)

    def _of(self, node: Node) -> _Place:
        return self._at(node.start_mark.line, node.start_mark.column)

    def _refuse(self, node: Node, inner: str, message: str) -> None:
        self._problems.append(self._problem_at(self._of(node), inner, message))

    def _value(self, node: Node, inner: str, depth: int) -> Any:
        self._places.setdefault(inner, self._of(node))
        # Repeated references could make a small text into a tree without end.
        if id(node) in self._visited:
            self._refuse(node, inner, "is an alias (*) of something further up; write it out")
            return None
        self._visited.add(id(node))
        if depth > DEEPEST:
            self._refuse(node, inner, f"is nested too deeply; it may be {DEEPEST} deep")
            return None
        if not isinstance(node, ScalarNode) and node.tag not in (f"{TAG}map", f"{TAG}seq"):
            self._refuse(node, inner, f"found the tag {node.tag.replace(TAG, '!!'):.60}; remove it")
        if isinstance(node, MappingNode):
            return dict(self._items(node, inner, depth))
        if isinstance(node, SequenceNode):
            return [self._value(item, f"{inner}[{i}]", depth + 1) for i, item in enumerate(node.value)]
        assert isinstance(node, ScalarNode), "there is no other kind of node"
        return self._scalar(node, inner)

    def _items(self, node: MappingNode, inner: str, depth: int) -> Iterator[tuple[str, Any]]:
        first: set[str] = set()
        for key_node, value_node in node.value:
            key = plain(key_node) if isinstance(key_node, ScalarNode) else None
            if not isinstance(key, str) or key_node.tag == f"{TAG}merge":
                self._refuse(key_node, inner, "has a key that is not a text; write a text before the ':'")
                continue
            if problem := refusal(key_node):
                self._refuse(key_node, inner, f"has a key that cannot be read: {problem}")
                continue
            if key in first:
                self._refuse(key_node, f"{inner}.{key}", "is given twice; remove one of them")
                continue
            first.add(key)
            self._places[f"{inner}.{key}"] = self._of(key_node)
            yield key, self._value(value_node, f"{inner}.{key}", depth + 1)

    def _scalar(self, node: ScalarNode, inner: str) -> Any:
        if problem := refusal(node):
            self._refuse(node, inner, problem)
            return None
        return plain(node)
