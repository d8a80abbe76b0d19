"""CustomResourceDefinitions from the pydantic models.

Pydantic writes JSON Schema 2020-12; the API server takes structural OpenAPI v3 schemas: no references, no ``anyOf`` with null,
a type everywhere. The models stay the single source of truth; ``scripts/generate`` writes the result to ``crds/``.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic.alias_generators import to_camel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from understudy.api.base import GROUP, VERSION, Model, rules
from understudy.api.schema.printed_kinds import KINDS, Kind

Schema = dict[str, Any]

PRESERVE = "x-kubernetes-preserve-unknown-fields"
VALIDATIONS = "x-kubernetes-validations"

# In the order in which they are written. A keyword that is not listed here has no meaning for the API server, so it is an error.
_KEYWORDS = (
    "type",
    "format",
    "description",
    "default",
    "enum",
    "nullable",
    "pattern",
    "minLength",
    "maxLength",
    "minimum",
    "maximum",
    "minItems",
    "maxItems",
    "minProperties",
    "maxProperties",
    "required",
    "properties",
    "additionalProperties",
    "items",
    PRESERVE,
    "x-kubernetes-embedded-resource",
    "x-kubernetes-int-or-string",
    "x-kubernetes-list-type",
    "x-kubernetes-list-map-keys",
    "x-kubernetes-map-type",
    VALIDATIONS,
)


def definition(kind: Kind) -> dict[str, Any]:
    """Return the CustomResourceDefinition (apiextensions.k8s.io/v1) of a kind."""
    version: dict[str, Any] = {
        "name": VERSION,
        "served": True,
        "storage": True,
        "additionalPrinterColumns": [
            {"name": c.name, "type": c.type, "description": c.description, "jsonPath": c.path}
            | ({"priority": 1} if c.wide else {})
            for c in kind.columns
        ],
        "subresources": {"status": {}},
        "schema": {"openAPIV3Schema": _with_defaults_in_words(root(kind))},
    }
    if kind.scales:
        version["subresources"]["scale"] = {
            "specReplicasPath": ".spec.replicas",
            "statusReplicasPath": ".status.replicas",
            "labelSelectorPath": ".status.selector",
        }
    return {
        "apiVersion": "apiextensions.k8s.io/v1",
        "kind": "CustomResourceDefinition",
        "metadata": {"name": f"{kind.plural}.{GROUP}"},
        "spec": {
            "group": GROUP,
            "names": {
                "kind": kind.name,
                "listKind": f"{kind.name}List",
                "plural": kind.plural,
                "singular": kind.singular,
                "shortNames": [kind.short],
                "categories": ["understudy"],
            },
            "scope": "Namespaced",
            "versions": [version],
        },
    }


def definitions() -> dict[str, dict[str, Any]]:
    """Return all CustomResourceDefinitions by file name, such as ``understudy.dev_robotworkloads.yaml``."""
    return {f"{GROUP}_{kind.plural}.yaml": definition(kind) for kind in KINDS}


def root(kind: Kind) -> Schema:
    """Return the schema of the whole object."""
    result: Schema = {
        "type": "object",
        "description": kind.description,
        "required": ["spec"],
        "properties": {
            "apiVersion": {"type": "string", "description": f"{GROUP}/{VERSION}"},
            "kind": {"type": "string", "description": kind.name},
            # The only field of the metadata that rules may use.
            "metadata": {"type": "object", "properties": {"name": {"type": "string"}}}
            if kind.rules
            else {"type": "object"},
            "spec": structural(kind.spec),
            "status": _without_defaults(structural(kind.status)),
        },
    }
    return result | (rules(*kind.rules) if kind.rules else {})


def structural(model: type[Model]) -> Schema:
    """Return a model's structural schema (KEP-1693): references are inlined, and optional fields are simply not required."""
    schema = model.model_json_schema(by_alias=True, schema_generator=_DescribedSchema)
    return _convert(schema, schema.get("$defs", {}), model.__name__)


class _DescribedSchema(GenerateJsonSchema):
    """The docstrings of fields are their descriptions. They are read from the source only here, because pydantic would
    read them at every start of a process (``use_attribute_docstrings``)."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the schema of a model."""
        found = super().model_schema(schema)
        model: type[Model] = schema["cls"]
        for base in reversed(model.__mro__[: model.__mro__.index(Model)]):
            for field, text in _descriptions(base.__module__).get(base.__name__, {}).items():
                found["properties"][to_camel(field)]["description"] = text
        return found


@cache
def _descriptions(module: str) -> Mapping[str, Mapping[str, str]]:
    """Return the docstrings of the fields of a module's classes, by class and field."""
    found: dict[str, dict[str, str]] = {}
    classes = (one for one in ast.parse(inspect.getsource(sys.modules[module])).body if isinstance(one, ast.ClassDef))
    for one in classes:
        for field, text in pairwise(one.body):
            match field, text:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(words))):
                    found.setdefault(one.name, {})[name] = " ".join(words.split())
    return found


def _convert(node: Mapping[str, Any], shared: Mapping[str, Schema], where: str) -> Schema:
    schema = _resolved(node, shared)
    schema.pop("title", None)
    schema.pop("$defs", None)
    if "const" in schema:
        schema["enum"] = [schema.pop("const")]
    if schema.get("default", ...) is None:
        del schema["default"]
    if schema.get("additionalProperties") is True:  # dict[str, Any]
        del schema["additionalProperties"]
        if "properties" not in schema:
            schema[PRESERVE] = True
    if "description" in schema:
        schema["description"] = schema["description"].replace("``", "`")
    if any(rule["rule"] == f"self.matches(r'{schema.get('pattern')}')" for rule in schema.get(VALIDATIONS, ())):
        del schema["pattern"]  # the rule reports it in words

    if unknown := schema.keys() - set(_KEYWORDS):
        raise ValueError(f"{where}: a structural schema cannot express {', '.join(sorted(unknown))}")
    if "type" not in schema:
        raise ValueError(f"{where}: a structural schema needs a type, and only unions with None have one")

    if "properties" in schema:
        required = schema.get("required", ())
        properties = {}
        for name, child in schema["properties"].items():
            converted = _convert(child, shared, f"{where}.{name}")
            optional = name not in required and "anyOf" not in child
            properties[name] = _with_fields_default(converted) if optional else converted
        schema["properties"] = properties
    for key in ("items", "additionalProperties"):
        if key in schema:
            schema[key] = _convert(schema[key], shared, f"{where}.{key}")
    return _ordered(schema)


def _ordered(schema: Schema) -> Schema:
    return {key: schema[key] for key in _KEYWORDS if key in schema}


def _resolved(node: Mapping[str, Any], shared: Mapping[str, Schema]) -> Schema:
    """Resolve a node's reference and its ``anyOf`` with null. Keywords of the node itself take precedence."""
    schema = dict(node)
    if "anyOf" in schema:
        others = [choice for choice in schema.pop("anyOf") if choice != {"type": "null"}]
        if len(others) == 1:
            schema = _resolved(others[0], shared) | schema
    if "$ref" in schema:
        name = schema.pop("$ref").removeprefix("#/$defs/")
        schema = _resolved(shared[name], shared) | schema
    return schema


def _with_fields_default(schema: Schema) -> Schema:
    """Add a default to an object whose fields have defaults. The API server applies those only if the object is present."""
    if "default" in schema or schema.get("required") or PRESERVE in schema:
        return schema
    defaults = {name: child["default"] for name, child in schema.get("properties", {}).items() if "default" in child}
    return _ordered(schema | {"default": defaults}) if defaults else schema


def _with_defaults_in_words(schema: Schema) -> Schema:
    """Return the schema with the defaults of its fields in their descriptions too, because ``kubectl explain`` prints only these."""
    result = dict(schema)
    if "properties" in result:
        result["properties"] = {name: _with_defaults_in_words(child) for name, child in result["properties"].items()}
    if "items" in result:
        result["items"] = _with_defaults_in_words(result["items"])
    default = result.get("default")
    if "description" in result and default not in (None, "") and not isinstance(default, list | dict):
        shown = str(default).lower() if isinstance(default, bool) else default
        result["description"] = f"{result['description']} Default: {shown}."
    return result


def _without_defaults(schema: Schema) -> Schema:
    """Return the schema without defaults, so that a status never shows values that nobody reported."""
    result = {key: value for key, value in schema.items() if key != "default"}
    if "properties" in result:
        result["properties"] = {name: _without_defaults(child) for name, child in result["properties"].items()}
    for key in ("items", "additionalProperties"):
        if key in result:
            result[key] = _without_defaults(result[key])
    return result
