"""What was written in XML as a node of the short form, and where each part of that was written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from understudy.trees.btcpp.markup import Element
from understudy.trees.problems import Problem

LONGEST_MESSAGE = 500
"""Characters of a message; some repeat what was found."""

_LAST = re.compile(r"(\.[^.\[\]]*|\[[0-9]+\])$")


@dataclass(frozen=True)
class Found:
    """A problem and where it is, by which it is put in order."""

    line: int
    column: int
    problem: Problem


@dataclass(frozen=True)
class Origin:
    """Where a node comes from."""

    label: str
    """Such as ``<Topic>``."""
    line: int
    column: int
    uses: tuple[int, ...] = ()
    """The lines of the <SubTree> nodes by way of which it is in the tree, the outermost first."""

    @classmethod
    def of(cls, element: Element, uses: tuple[int, ...] = ()) -> Origin:
        """That of an element."""
        identity = f' ID="{repr(element.attributes["ID"])[1:-1]:.60}"' if "ID" in element.attributes else ""
        return cls(f"<{element.tag:.60}{identity}>", element.line, element.column, uses)

    @property
    def place(self) -> str:
        """Such as ``line 7, column 5``."""
        by = f" (used in line {', '.join(map(str, self.uses))})" if self.uses else ""
        return f"line {self.line}, column {self.column}{by}"

    def problem(self, path: str, message: str, attribute: str = "") -> Found:
        """A problem here, or with an attribute that is here."""
        what = f"{self.label} {attribute:.60}" if attribute else self.label
        return Found(self.line, self.column, Problem(f"{path}, {self.place}", f"{what}: {message:.{LONGEST_MESSAGE}}"))


@dataclass(frozen=True)
class Written:
    """A node that could be read, with those of its values and children that could be."""

    origin: Origin
    key: str
    """What it is in the short form."""
    name: str | None
    ports: Mapping[str, str] = field(default_factory=dict)
    """By port, where its value goes in the short form."""
    values: Mapping[str, str] = field(default_factory=dict)
    """By port, what it was given."""
    children: list[Written] = field(default_factory=list)


class SourceMap:
    """Says of problems with the short form where they are in the text."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._places: dict[str, tuple[Origin, str]] = {}

    def short_form(self, written: Written) -> dict[str, Any]:
        """The node of the short form. The places of all that is in it are noted."""
        return self._node(written, self._path)

    def called(self, path: str) -> str:
        """How another node is called in a message."""
        origin, _ = self._find(path)
        return f"{origin.label} in {origin.place}"

    def problem(self, found: Problem) -> Found:
        """A problem with the short form as one of the text."""
        origin, port = self._find(found.path)
        return origin.problem(self._path, found.message, port)

    def _node(self, written: Written, path: str) -> dict[str, Any]:
        self._places[path] = (written.origin, "")
        self._places[f"{path}.name"] = (written.origin, "name")
        node: dict[str, Any] = {"name": written.name} if written.name is not None else {}
        for port, where in written.ports.items():
            self._places[f"{path}.{where}"] = (written.origin, port)
            *above, last = where.split(".")
            inner = node
            for key in above:
                inner = inner.setdefault(key, {})
            if port in written.values:
                inner[last] = written.values[port]
        if written.key == "while":
            node["do"] = self._node(written.children[0], f"{path}.do")
        elif written.key == "inverter":
            node["inverter"] = self._node(written.children[0], f"{path}.inverter")
        elif written.children:
            node[written.key] = [
                self._node(child, f"{path}.{written.key}[{index}]") for index, child in enumerate(written.children)
            ]
        return node

    def _find(self, path: str) -> tuple[Origin, str]:
        while path not in self._places and (shorter := _LAST.sub("", path)) != path:
            path = shorter
        return self._places.get(path) or self._places[self._path]
