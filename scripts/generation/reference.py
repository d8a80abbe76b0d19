"""Builds the reference page of the API from the schemas of the CustomResourceDefinitions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from understudy.api.base import API_VERSION
from understudy.api.schema.definitions import PRESERVE, VALIDATIONS, root
from understudy.api.schema.printed_kinds import KINDS, Kind

Schema = dict[str, Any]


def page() -> str:
    """Return the whole page as Markdown."""
    links = ", ".join(f"[{kind.name}](#{kind.singular})" for kind in KINDS)
    lines = [
        "# API reference",
        "",
        "<!-- Written by scripts/generate from the models in operator/understudy/api: change those. -->",
        "",
        f"The kinds of `{API_VERSION}`, all namespaced: {links}. The same is in the cluster: `kubectl explain rw.spec.outputs`.",
        "Durations are numbers with `ms`, `s`, `m` or `h`, such as `500ms` or `1m30s`.",
    ]
    for kind in KINDS:
        lines += ["", *_kind(kind)]
    return "\n".join(lines) + "\n"


def _kind(kind: Kind) -> Iterator[str]:
    schema = root(kind)
    yield f"## {kind.name}"
    yield ""
    yield kind.description
    yield ""
    yield f"Short name `{kind.short}`. `kubectl get {kind.short}` prints {', '.join(c.name for c in kind.columns)}."
    if kind.scales:
        yield f"`kubectl scale {kind.short} NAME --replicas=N` works."
    for part, title in (("spec", "What you say"), ("status", "What is so")):
        yield ""
        yield f"### {kind.name}: {title} (`{part}`)"
        yield ""
        if part == "spec":
            yield "| field | type | default | description |"
            yield "| --- | --- | --- | --- |"
        else:
            yield "| field | type | description |"
            yield "| --- | --- | --- |"
        for path, field, required in _fields(schema["properties"][part], part):
            cells = [f"`{path}`", _type(field), _default(field, required), _cell(field.get("description", ""))]
            if part == "status":
                del cells[2]
            yield f"| {' | '.join(cells)} |"
    if rules := list(_rules(schema, "")):
        yield ""
        yield f"### {kind.name}: What is refused"
        yield ""
        for path, message in rules:
            yield f"- `{path}`: {message}"


def _fields(schema: Schema, path: str) -> Iterator[tuple[str, Schema, bool]]:
    """Yield all fields below a schema, depth first: path, schema, whether required."""
    for name, child in schema.get("properties", {}).items():
        below = f"{path}.{name}"
        yield below, child, name in schema.get("required", ())
        yield from _fields(child, below)
        if "items" in child:
            yield from _fields(child["items"], f"{below}[]")


def _rules(schema: Schema, path: str) -> Iterator[tuple[str, str]]:
    """Yield the messages of the rules in a schema, each with the path that it concerns."""
    for rule in schema.get(VALIDATIONS, ()):
        yield (path + rule.get("fieldPath", "")).removeprefix(".") or "object", rule["message"]
    for name, child in schema.get("properties", {}).items():
        yield from _rules(child, f"{path}.{name}")
    if "items" in schema:
        yield from _rules(schema["items"], f"{path}[]")


def _type(schema: Schema) -> str:
    if "enum" in schema:
        return " \\| ".join(f"`{value}`" for value in schema["enum"])
    kind: str = schema["type"]
    if kind == "array":
        return f"list of {_type(schema['items'])}"
    if kind == "object" and "additionalProperties" in schema:
        return f"map of {_type(schema['additionalProperties'])}"
    if kind == "object" and schema.get(PRESERVE) and "properties" not in schema:
        return "object, free"
    if schema.get("format") == "date-time":
        return "time"
    bounds = [schema.get("minimum"), schema.get("maximum")]
    if None not in bounds:
        return f"{kind}, {bounds[0]} to {bounds[1]}"
    return kind


def _default(schema: Schema, required: bool) -> str:
    if required:
        return "required"
    if "default" not in schema or schema["type"] == "object":
        return ""
    return f"`{json.dumps(schema['default'])}`"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
