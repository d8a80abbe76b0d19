"""Reads manifests as ``kubectl apply`` does, and records the position of each field in the file.

No content of a file raises an error: what cannot be read becomes a finding.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from understudy.api.nesting import DEEPEST_OBJECT
from understudy.cli.common.errors import CommandError
from understudy.cli.manifests.check_findings import Finding, Place
from understudy.cli.manifests.schema_validation import join
from understudy.trees.source.positions import TextOffset
from understudy.trees.source.yaml_scalars import HALF_CHARACTER, TAG, Loader, has_half_character, plain

SUFFIXES = (".yaml", ".yml")
STANDARD_INPUT = "-"

MOST = 200_000
"""Most values of a file with all aliases expanded: a short file may expand to billions."""

_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
_HINTS = {
    "\\t": "indent with spaces: YAML does not allow tabs there",
    "mapping values are not allowed here": "quote a text that contains ': ', and check the indentation of this line",
    "could not find expected ':'": "check the previous line: a key needs ': ', and a text over several lines must be indented",
    "expected <block end>": "check the indentation: lines of one mapping or list begin in the same column",
    "found undefined alias": "define the anchor (&name) before it, or quote a text that begins with *",
    "did not find expected": "a bracket, brace or quote is not closed, or a comma is missing",
    "expected ',' or": "a bracket or brace is not closed, or a comma is missing",
    "while scanning a quoted scalar": "close the quotes",
}


@dataclass
class Manifest:
    """One object of a file."""

    file: str
    data: Any
    """As the API server would receive it; not always a mapping."""
    places: dict[str, Place] = field(default_factory=dict)
    """By path, the position of a field: its key, or the first character of an item."""
    texts: dict[str, TextOffset] = field(default_factory=dict)
    """By path, the position of the first character of a text, if its lines and columns are those of the file."""

    spelled: dict[str, str] = field(default_factory=dict)
    """By path, words other than true and false that YAML parses as booleans, such as ``on``."""

    def place(self, path: str) -> Place:
        """Return the position of a field, or of its closest existing parent."""
        while path not in self.places:
            path = path[: max(path.rfind("."), path.rfind("["), 0)]
        return self.places[path]

    @property
    def kind(self) -> str:
        """Its kind; empty if missing."""
        return self._text("kind")

    @property
    def name(self) -> str:
        """Its name; empty if missing."""
        return self._text("metadata", "name")

    @property
    def namespace(self) -> str:
        """Its namespace; empty if missing."""
        return self._text("metadata", "namespace")

    @property
    def labels(self) -> dict[str, str]:
        """Its labels."""
        found = at(self.data, "metadata", "labels")
        return {key: value for key, value in found.items() if isinstance(value, str)} if isinstance(found, dict) else {}

    def together(self, other: Manifest) -> bool:
        """Return whether two objects may be in one namespace; without one, it is chosen when they are applied."""
        return not self.namespace or not other.namespace or self.namespace == other.namespace

    def _text(self, *keys: str) -> str:
        found = at(self.data, *keys)
        return found if isinstance(found, str) else ""

    @property
    def subject(self) -> str:
        """Its name in findings."""
        return f"{self.kind} {self.name or '(no name)'}" if self.kind else ""

    def finding(self, path: str, message: str, *, warning: bool = False, place: Place | None = None) -> Finding:
        """Return a finding about one of its fields."""
        if path in self.spelled:
            message += f'. YAML reads the unquoted word {self.spelled[path]} as a boolean: write "{self.spelled[path]}" if you mean text'
        return Finding(
            self.file, place or self.place(path), "warning" if warning else "error", self.subject, path, message
        )


def at(data: Any, *keys: str | int) -> Any:
    """Return a nested value; None if it is missing, or if a parent is not what it should be."""
    try:
        for key in keys:
            data = data[key]
    except (TypeError, LookupError):
        return None
    return data


def items(data: Any, *keys: str) -> list[Any]:
    """Return the items of a nested list; none if it is not a list."""
    found = at(data, *keys)
    return found if isinstance(found, list) else []


class TooMuch(Exception):
    """The file is too large or too deeply nested."""

    def __init__(self, node: Node, message: str) -> None:
        super().__init__(message)
        self.node, self.message = node, message


def contents(arguments: Iterable[str], *, recursive: bool = False) -> dict[str, bytes]:
    """Return the contents of the files that arguments select, by name, each once; with ``recursive``, those of subfolders of folders too.

    Raises CommandError.
    """
    return dict(entry for argument in dict.fromkeys(arguments) for entry in _contents(argument, recursive))


def _contents(argument: str, recursive: bool) -> Iterator[tuple[str, bytes]]:
    if argument == STANDARD_INPUT:
        yield "<stdin>", sys.stdin.buffer.read()
        return
    path = Path(argument)
    try:
        if not path.is_dir():
            yield argument, path.read_bytes()
            return
        inside = path.rglob("*") if recursive else path.iterdir()
        found = sorted(one for one in inside if one.suffix in SUFFIXES and one.is_file())
        for one in found:
            yield str(one), one.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: an invalid file name
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise CommandError(
            f"{argument}: {why}; give a file, a folder with *.yaml or *.yml files, or - for standard input"
        ) from error
    if not found:
        has_folders = not recursive and any(one.is_dir() for one in path.iterdir())
        inner = "; add -R (--recursive) to read its subfolders" if has_folders else ""
        raise CommandError(f"{argument}: no *.yaml and no *.yml in this folder{inner}")


def read(file: str, content: bytes) -> tuple[list[Manifest], list[Finding]]:
    """Return the objects of a file, including those in lists, and the problems of the file itself."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8", "replace")
        place = Place(before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1)
        return [], [Finding(file, place, "error", "", "", "the file is not UTF-8; save it as UTF-8 text")]
    reader = _Reader(file, text)
    reader.read()
    return reader.manifests, reader.findings


class _Reader:
    def __init__(self, file: str, text: str) -> None:
        self._file, self._text = file, text
        self._lines = _BREAK.split(text)
        self._count = 0
        self.manifests: list[Manifest] = []
        self.findings: list[Finding] = []

    def read(self) -> None:
        nothing = True
        try:
            for node in self._documents():
                if _is_null(node):  # such as after the last ---
                    continue
                nothing = False
                self._objects(node, 0)
        except yaml.MarkedYAMLError as error:
            self._broken(error)
        except yaml.reader.ReaderError as error:
            before = self._text[: error.position]
            place = Place(len(_BREAK.split(before)), len(_BREAK.split(before)[-1]) + 1)
            self._note(place, f"found the character {chr(error.character)!a}, which YAML does not allow; remove it")
        except TooMuch as error:
            self._note(_place(error.node), error.message)
        except RecursionError:
            self._note(Place(1, 1), f"mappings and lists are nested too deeply; the limit is {DEEPEST_OBJECT} levels")
        else:
            if nothing:
                self._note(Place(1, 1), "the file is empty; add apiVersion, kind, metadata and spec", warning=True)

    def _documents(self) -> Iterator[Node]:
        loader = Loader(self._text)
        try:
            while loader.check_node():
                node = loader.get_node()
                if node is not None:
                    yield node
        finally:
            loader.dispose()

    def _broken(self, error: yaml.MarkedYAMLError) -> None:
        mark = error.problem_mark or error.context_mark
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        start, beyond = error.context_mark, error.problem_mark
        if start and beyond and start.line != beyond.line:
            problem += f" (started in line {start.line + 1}, column {start.column + 1})"
        hint = next((hint for found, hint in _HINTS.items() if found in problem), "correct the YAML here")
        if mark and any("{{" in line for line in self._lines[max(mark.line - 1, 0) : mark.line + 1]):
            hint = "render a Helm template first: helm template ... | understudy check -"
        self._note(
            Place(mark.line + 1, mark.column + 1) if mark else Place(1, 1), f"this is not valid YAML: {problem}; {hint}"
        )

    def _note(self, place: Place, message: str, *, warning: bool = False) -> None:
        self.findings.append(Finding(self._file, place, "warning" if warning else "error", "", "", message))

    # -- objects ----------------------------------------------------------------------------------------------------

    def _objects(self, node: Node, depth: int) -> None:
        """Read the object of a node, or the objects of a list."""
        items = _items(node)
        if items is None or depth > DEEPEST_OBJECT:
            self._object(node)
            return
        for item in items:
            self._objects(item, depth + 1)

    def _object(self, node: Node) -> None:
        if not isinstance(node, MappingNode):
            what = "a list" if isinstance(node, SequenceNode) else "a text or number"
            self._note(_place(node), f"found {what}; a manifest is a mapping with apiVersion, kind, metadata and spec")
            return
        manifest = Manifest(self._file, None, {"": _place(node)})
        values = _Values(self, manifest)
        manifest.data = values.value(node, "", 0)
        self.manifests.append(manifest)
        self.findings += (
            manifest.finding(path, message, warning=warning, place=place)
            for path, message, place, warning in values.problems
        )

    def counted(self, node: Node) -> None:
        """Count one more value. Raises TooMuch."""
        self._count += 1
        if self._count > MOST:
            raise TooMuch(node, f"more than {MOST} values with all aliases expanded; reduce them")

    def beginning(self, node: ScalarNode) -> TextOffset | None:
        """Return where a text begins in the file; None if its lines are not those of the file."""
        start, end = node.start_mark, node.end_mark
        if node.style == "|":
            for number, line in enumerate(node.value.split("\n")):
                if line.strip():
                    at = start.line + 1 + number
                    raw = self._lines[at] if at < len(self._lines) else ""
                    return TextOffset(start.line + 1, len(raw) - len(line)) if raw.endswith(line) else None
            return None
        if start.line == end.line and node.style != ">":
            quote = 1 if node.style else 0
            raw = self._lines[start.line][start.column + quote : end.column - quote]
            return TextOffset(start.line, start.column + quote) if raw == node.value else None
        return None


class _Values:
    """Converts nodes into JSON values and records their positions."""

    def __init__(self, reader: _Reader, manifest: Manifest) -> None:
        self._reader, self._manifest = reader, manifest
        self._within: set[int] = set()
        self._paths: dict[int, str] = {}
        self._alias_reported = False
        self.problems: list[tuple[str, str, Place, bool]] = []

    def value(self, node: Node, path: str, depth: int) -> Any:
        """Return the value of a node."""
        self._reader.counted(node)
        if depth > DEEPEST_OBJECT:
            raise TooMuch(node, f"mappings and lists are nested too deeply; the limit is {DEEPEST_OBJECT} levels")
        if id(node) in self._within:
            self._problem(path, "contains itself through an alias (*); write the value out", _place(node))
            return None
        if id(node) in self._paths and not self._alias_reported:
            self._alias_reported = True
            self._problem(
                path,
                f"is an alias (*) of {self._paths[id(node)] or 'the top level'}; it has the same value, but the stored object "
                "contains it twice, so write it out",
                self._manifest.place(path),
                warning=True,
            )
        self._paths.setdefault(id(node), path)
        self._within.add(id(node))
        try:
            if isinstance(node, MappingNode):
                return self._mapping(node, path, depth)
            if isinstance(node, SequenceNode):
                return self._sequence(node, path, depth)
            assert isinstance(node, ScalarNode), "there is no other kind of node"
            return self._scalar(node, path)
        finally:
            self._within.discard(id(node))

    def _mapping(self, node: MappingNode, path: str, depth: int) -> dict[str, Any]:
        self._tagged(node, path, "map")
        found: dict[str, Any] = {}
        first: dict[str, Place] = {}
        merged: list[Node] = []
        for key_node, value_node in node.value:
            if key_node.tag == f"{TAG}merge":
                merged += value_node.value if isinstance(value_node, SequenceNode) else [value_node]
                continue
            key = self._key(key_node, path)
            if key is None:
                continue
            inner = join(path, key)
            if key in first:
                message = f"is given twice, first in line {first[key].line}; remove one of them"
                self._problem(inner, message, _place(key_node))
                continue
            first[key] = self._manifest.places[inner] = _place(key_node)
            if isinstance(value_node, ScalarNode) and (begins := self._reader.beginning(value_node)) is not None:
                self._manifest.texts[inner] = begins
            found[key] = self.value(value_node, inner, depth + 1)
        for other in merged:
            found = self._merged(other, path, depth) | found
        return found

    def _merged(self, node: Node, path: str, depth: int) -> dict[str, Any]:
        """Return what ``<<`` adds; keys next to it take precedence."""
        if not isinstance(node, MappingNode):
            self._problem(path, "<< needs a mapping or a list of mappings; write the fields out", _place(node))
            return {}
        before = dict(self._manifest.places)
        found = self.value(node, path, depth + 1)
        self._manifest.places.update(before)
        return found if isinstance(found, dict) else {}

    def _key(self, node: Node, path: str) -> str | None:
        key = plain(node) if isinstance(node, ScalarNode) else None
        if key is None:
            self._problem(path, "has a key that is not a text; write a text before the ':'", _place(node))
            return None
        return key if isinstance(key, str) else str(key).lower() if isinstance(key, bool) else str(key)

    def _sequence(self, node: SequenceNode, path: str, depth: int) -> list[Any]:
        self._tagged(node, path, "seq")
        found = []
        for index, item in enumerate(node.value):
            inner = f"{path}[{index}]"
            self._manifest.places[inner] = _place(item)
            found.append(self.value(item, inner, depth + 1))
        return found

    def _scalar(self, node: ScalarNode, path: str) -> Any:
        self._tagged(node, path, "str", "bool", "int", "float", "null", "timestamp", "merge", "value")
        found = plain(node)
        if has_half_character(node.value):
            self._problem(path, HALF_CHARACTER, self._manifest.place(path))
            return ""
        if isinstance(found, float) and not math.isfinite(found):
            self._problem(
                path, f"found {node.value}, which JSON does not support; give a number", self._manifest.place(path)
            )
            return node.value
        if isinstance(found, bool) and node.value not in ("true", "false"):
            self._manifest.spelled[path] = node.value
        return found

    def _tagged(self, node: Node, path: str, *known: str) -> None:
        if node.tag not in [f"{TAG}{name}" for name in known]:
            tag = node.tag.replace(TAG, "!!")
            self._problem(path, f"found the tag {tag:.60}, which manifests do not support; remove it", _place(node))

    def _problem(self, path: str, message: str, place: Place, *, warning: bool = False) -> None:
        self.problems.append((path, message, place, warning))


def _place(node: Node) -> Place:
    return Place(node.start_mark.line + 1, node.start_mark.column + 1)


def _is_null(node: Node) -> bool:
    return isinstance(node, ScalarNode) and node.tag == f"{TAG}null"


def _items(node: Node) -> list[Node] | None:
    """Return the items of a node that is a list of objects, as ``kubectl get -o yaml`` writes it; None for other nodes."""
    if not isinstance(node, MappingNode):
        return None
    fields = {key.value: value for key, value in node.value if isinstance(key, ScalarNode)}
    kind, items = fields.get("kind"), fields.get("items")
    if not isinstance(kind, ScalarNode) or not kind.value.endswith("List") or not isinstance(items, SequenceNode):
        return None
    return list(items.value)
