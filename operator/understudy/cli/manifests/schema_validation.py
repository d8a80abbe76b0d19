"""Validates a value against a structural schema (KEP-1693) as the API server does on creation: strict, with defaults and CEL rules."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from understudy.api.schema.definitions import PRESERVE, VALIDATIONS, Schema
from understudy.cli.manifests import cel
from understudy.trees.source.problems import Problem, closest, did_you_mean
from understudy.trees.source.value_reader import found_text

_TYPES = {
    "object": "object (a mapping)",
    "array": "array (a list)",
    "string": "string (a text, in quotes if it looks like a number)",
    "integer": "integer (a whole number, without quotes)",
    "number": "number (without quotes)",
    "boolean": "boolean (true or false, without quotes)",
}

_CLASSES: dict[str, type] = {"object": Mapping, "array": list, "string": str, "boolean": bool}

_CHANGES = re.compile(r"\boldSelf\b")
"""Transition rules, which do not apply on creation."""


@dataclass(frozen=True)
class UnknownField(Problem):
    """A field that is unknown in the object in which it is given."""

    name: str


def join(path: str, key: object) -> str:
    """Return the path of a field."""
    return f"{path}.{key}" if path else str(key)


def validate(value: Any, schema: Schema, path: str = "") -> list[Problem]:
    """Return everything that the API server would refuse, or drop without strict validation."""
    return [_with_suggestion(problem, schema) for problem in _validate(_defaulted(value, schema), schema, path)]


def _with_suggestion(problem: Problem, schema: Schema) -> Problem:
    """Improve the message of an unknown field that exists in exactly one other place: most likely the indentation is wrong."""
    if not isinstance(problem, UnknownField):
        return problem
    elsewhere = [found for found in _fields(schema, "") if found.rpartition(".")[2] == problem.name]
    if len(elsewhere) != 1:
        return problem
    message = f"unknown field {problem.name!r:.80} here; it belongs to {elsewhere[0]}: check the indentation"
    return Problem(problem.path, message)


def _fields(schema: Schema, path: str) -> Iterator[str]:
    for name, child in schema.get("properties", {}).items():
        yield join(path, name)
        yield from _fields(child, join(path, name))
    if "items" in schema:
        yield from _fields(schema["items"], f"{path}[]")


def _defaulted(value: Any, schema: Schema) -> Any:
    """Return the value with the defaults that the API server sets before validation."""
    if isinstance(value, Mapping):
        result = dict(value)
        for name, child in schema.get("properties", {}).items():
            if result.get(name) is None:  # null counts as absent
                result.pop(name, None)
                if "default" in child:
                    result[name] = copy.deepcopy(child["default"])
            if name in result:
                result[name] = _defaulted(result[name], child)
        return result
    if isinstance(value, list) and "items" in schema:
        return [_defaulted(item, schema["items"]) for item in value]
    return value


def _validate(value: Any, schema: Schema, path: str) -> Iterator[Problem]:
    if not _is(value, schema["type"]):
        yield Problem(path, f"found {found_text(value)}; must be of type {_TYPES[schema['type']]}{_form(schema)}")
        return
    found = [Problem(path, message) for message in _bounds(value, schema)]
    if isinstance(value, Mapping):
        found += _object(value, schema, path)
    elif isinstance(value, list) and "items" in schema and not found:
        found += (p for i, item in enumerate(value) for p in _validate(item, schema["items"], f"{path}[{i}]"))
    yield from found
    if not found:  # rules rely on a value that matches the schema
        yield from _rules(value, schema, path)


def _is(value: Any, kind: str) -> bool:
    if kind in _CLASSES:
        return isinstance(value, _CLASSES[kind])
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, int) or (value.is_integer() if kind == "integer" else math.isfinite(value))


def _form(schema: Schema) -> str:
    """Return the format of a text, if the schema has a message for it."""
    messages = [rule["message"] for rule in schema.get(VALIDATIONS, ()) if "messageExpression" in rule]
    return f": {messages[0]}" if messages else ""


def _bounds(value: Any, schema: Schema) -> Iterator[str]:
    if "enum" in schema and value not in schema["enum"]:
        yield f"found {found_text(value)}; give one of {', '.join(json.dumps(choice) for choice in schema['enum'])}"
    if isinstance(value, str):
        size, unit, bounds = len(value), "chars long", ("minLength", "maxLength")
    elif isinstance(value, list):
        size, unit, bounds = len(value), "items", ("minItems", "maxItems")
    elif isinstance(value, Mapping):
        size, unit, bounds = len(value), "properties", ("minProperties", "maxProperties")
    else:
        if "minimum" in schema and value < schema["minimum"]:
            yield f"found {found_text(value)}; must be greater than or equal to {schema['minimum']}"
        if "maximum" in schema and value > schema["maximum"]:
            yield f"found {found_text(value)}; must be less than or equal to {schema['maximum']}"
        return
    must = "must be" if isinstance(value, str) else "must have"
    if size < schema.get(bounds[0], 0):
        yield f"found {found_text(value) if size else 'an empty value'}; {must} at least {schema[bounds[0]]} {unit}"
    if size > schema.get(bounds[1], math.inf):
        yield f"found {size} {unit}; {must} at most {schema[bounds[1]]} {unit}"
    elif isinstance(value, str) and "pattern" in schema and not cel.matches(value, schema["pattern"]):
        yield f"found {found_text(value)}; must match {schema['pattern']}"


def _object(value: Mapping[str, Any], schema: Schema, path: str) -> Iterator[Problem]:
    properties = schema.get("properties", {})
    absent = [known for known in properties if known not in value]
    # A required field whose name is misspelled is one mistake.
    misspelled = (
        {closest(str(name), absent) for name in value if name not in properties} if _is_strict(schema) else set()
    )
    for name in schema.get("required", ()):
        if name not in value and name not in misspelled:
            yield Problem(join(path, name), f"missing{_how_to_add(name, properties.get(name, {}))}")
    for name, item in value.items():
        if name in properties:
            yield from _validate(item, properties[name], join(path, name))
        elif "additionalProperties" in schema:
            yield from _validate(item, schema["additionalProperties"], join(path, name))
        elif _is_strict(schema):
            # One that is not given yet is meant more probably.
            hint = did_you_mean(str(name), absent if closest(str(name), absent) else properties)
            yield UnknownField(join(path, name), f"unknown field {name!r:.80}{hint}", str(name))


def _is_strict(schema: Schema) -> bool:
    """Whether an object may have the fields of the schema and no others."""
    return "additionalProperties" not in schema and PRESERVE not in schema


def _how_to_add(name: str, schema: Schema) -> str:
    choices = [json.dumps(choice) for choice in schema.get("enum", ())]
    description = schema.get("description", "").rstrip(".") or f"one of {', '.join(choices)}"
    return f", and required; add {name} ({description})"


def _rules(value: Any, schema: Schema, path: str) -> Iterator[Problem]:
    for rule in schema.get(VALIDATIONS, ()):
        if _CHANGES.search(rule["rule"]):
            continue
        try:
            if not cel.compiled(rule["rule"])({"self": value}):
                yield Problem((path + rule.get("fieldPath", "")).lstrip("."), _rule_message(rule, value))
        except cel.Undecided:
            continue  # it concerns a missing part


def _rule_message(rule: Mapping[str, str], value: Any) -> str:
    if "messageExpression" in rule:
        try:
            return str(cel.compiled(rule["messageExpression"])({"self": value}))
        except cel.Undecided:
            pass
    return rule["message"]
