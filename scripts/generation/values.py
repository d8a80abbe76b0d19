"""Builds the table of the chart's values from the comments in ``values.yaml``.

A comment that begins with ``# --`` describes the key on the next line that is not a comment. It becomes a table cell.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import yaml

BEGIN = "<!-- values: written by scripts/generate from values.yaml -->"
END = "<!-- end of values -->"

_KEY = re.compile(r"^(?P<indent> *)(?P<key>[A-Za-z][A-Za-z0-9_]*):")
_INDENT = 2


@dataclass(frozen=True)
class Value:
    """A documented value."""

    path: str
    description: str
    default: Any


def documented(text: str) -> Iterator[Value]:
    """Yield the described values in their order.

    Raises ValueError for a leaf without a description.
    """
    data = yaml.safe_load(text)
    parents: list[str] = []
    comment: list[str] = []
    described: set[str] = set()
    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith("# --"):
            comment = [stripped.removeprefix("# --").strip()]
        elif stripped.startswith("#") and comment:
            comment.append(stripped.removeprefix("#").strip())
        elif match := _KEY.match(line):
            depth = len(match["indent"]) // _INDENT
            parents = [*parents[:depth], match["key"]]
            if comment:
                path = ".".join(parents)
                described.add(path)
                yield Value(path, " ".join(comment), _at(data, parents))
            comment = []
        else:
            comment = []
    for path in _leaves(data):
        if not any(path == known or path.startswith(f"{known}.") for known in described):
            raise ValueError(f"values.yaml: {path} has no description: put a comment that begins with '# --' above it")


def table(text: str) -> str:
    """Return the table as Markdown."""
    rows = [f"| `{value.path}` | {value.description} | `{json.dumps(value.default)}` |" for value in documented(text)]
    return "\n".join(["| value | what it does | default |", "| --- | --- | --- |", *rows])


def between_markers(page: str, content: str, first: str = BEGIN, last: str = END) -> str:
    """Return the page with the content between the two markers replaced.

    Raises ValueError if a marker is missing.
    """
    before, begin, rest = page.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise ValueError(f"the page must have the two lines {first!r} and {last!r}")
    return f"{before}{first}\n{content}\n{last}{after}"


def _at(data: Any, path: list[str]) -> Any:
    for key in path:
        data = data[key]
    return data


def _leaves(data: Any, path: str = "") -> Iterator[str]:
    if isinstance(data, dict) and data:
        for key, value in data.items():
            yield from _leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path
