"""Checks one object: with the schema of its kind, the models, and the loaders and rules of monitor and operator."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from understudy.api.base import API_VERSION, GROUP, OBJECT_NAME_MESSAGE, OBJECT_NAME_PATTERN, pattern_rule, seconds
from understudy.api.kinds.fallback_pool import FallbackPoolSpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.schema.definitions import PRESERVE, VALIDATIONS, Schema, definition
from understudy.api.schema.printed_kinds import KINDS, Kind
from understudy.cli.manifests.check_findings import Finding, Place
from understudy.cli.manifests.manifest_reader import Manifest, at, items
from understudy.cli.manifests.schema_validation import validate
from understudy.controller.desired import mux_validation, reflex_validation
from understudy.controller.pods import instance_pod
from understudy.kube.gates import registry
from understudy.trees.languages.notations import FORMS, TEXTS, load_health
from understudy.trees.languages.procedure_notations import compose
from understudy.trees.source.positions import WHOLE_FILE, TextOffset
from understudy.trees.source.problems import Problem, TreeError, did_you_mean
from understudy.trees.source.value_reader import found_text

_BY_NAME = {kind.name: kind for kind in KINDS}

_LABEL_PATTERN = r"^(([A-Za-z0-9][-A-Za-z0-9_.]*)?[A-Za-z0-9])?$"
_LABEL_MESSAGE = (
    "a label consists of letters, digits, dashes, underscores and dots, and begins and ends with a letter or digit"
)

_TEXT: Schema = {"type": "string"}
_OPAQUE: Schema = {"type": "object", PRESERVE: True}
_METADATA: Schema = {
    "type": "object",
    "description": "Its name, its namespace and its labels.",
    "properties": {
        "name": {"type": "string", "minLength": 1, "maxLength": 253, "description": "Name of the object."}
        | pattern_rule(OBJECT_NAME_PATTERN, OBJECT_NAME_MESSAGE),
        "namespace": _TEXT,
        "labels": {
            "type": "object",
            "additionalProperties": {"type": "string", "maxLength": 63} | pattern_rule(_LABEL_PATTERN, _LABEL_MESSAGE),
        },
        "annotations": {"type": "object", "additionalProperties": _TEXT},
        "generateName": _TEXT,
        "finalizers": {"type": "array", "items": _TEXT},
        "ownerReferences": {"type": "array", "items": _OPAQUE},
        # What `kubectl get -o yaml` adds.
        **dict.fromkeys(("uid", "resourceVersion", "selfLink", "creationTimestamp", "deletionTimestamp"), _TEXT),
        **{name: {"type": "integer"} for name in ("generation", "deletionGracePeriodSeconds")},
        "managedFields": {"type": "array", "items": _OPAQUE},
    },
}
"""Schema of ``metadata`` (ObjectMeta), which no CRD contains."""

_PLACE = re.compile(r", line (\d+), column (\d+)")
"""The position of a problem, which loaders append to the path of the text."""


def is_ours(manifest: Manifest) -> bool:
    """Return whether an object is, or is meant to be, of one of Understudy's kinds."""
    version = manifest.data.get("apiVersion")
    ours = isinstance(version, str) and version.partition("/")[0] == GROUP
    return ours or manifest.kind in _BY_NAME


def check(manifest: Manifest) -> list[Finding]:
    """Return all problems of an object by itself."""
    data, found = manifest.data, []
    if data.get("apiVersion") != API_VERSION:
        message = f"found {found_text(data.get('apiVersion'))}; give {API_VERSION}"
        found.append(manifest.finding("apiVersion", message))
    kind = _BY_NAME.get(manifest.kind)
    if kind is None:
        shown = found_text(data.get("kind"))
        found.append(manifest.finding("kind", f"found {shown}{did_you_mean(manifest.kind, _BY_NAME)}"))
        return found
    problems = validate(data, _schema(kind))
    found += (manifest.finding(problem.path, problem.message) for problem in problems)
    spec = data.get("spec")
    if not isinstance(spec, Mapping):
        return found
    found += _trees(manifest, kind, spec)
    if not any(problem.path.startswith("spec") for problem in problems):
        found += (manifest.finding(problem.path, problem.message) for problem in _operator_rules(kind, spec))
    return found


@functools.cache
def _schema(kind: Kind) -> Schema:
    """Return the schema of a whole object, which the API server composes of the CRD and its own parts."""
    served = definition(kind)["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
    identity = {"apiVersion": _TEXT, "kind": _TEXT, "metadata": _METADATA, "status": _OPAQUE}
    schema: Schema = {
        "type": "object",
        "required": ["metadata", "spec"],
        "properties": identity | {"spec": served["properties"]["spec"]},
        VALIDATIONS: [
            {"rule": "has(self.metadata.name) || has(self.metadata.generateName)", "fieldPath": ".metadata.name"}
            | {"message": "missing; set a name of lower-case letters, digits and dashes"},
            *served.get(VALIDATIONS, ()),
        ],
    }
    return schema


# -- trees ------------------------------------------------------------------------------------------------------------


def _trees(manifest: Manifest, kind: Kind, spec: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield the problems that the loaders find in the trees of an object. The schema check reports what is not a tree at all."""
    match kind.name:
        case "RobotWorkload":
            yield from _procedure(manifest, spec, "bringUp")
            for index, dependency in enumerate(items(spec, "dependsOn")):
                yield from _procedure(manifest, dependency, "procedure", f"spec.dependsOn[{index}]")
        case "FallbackPool":
            yield from _procedure(manifest, spec, "initialization")
            yield from _procedure(manifest, spec, "readinessCheck", check=True)
        case "FailurePolicy":
            monitoring = spec.get("monitoring")
            yield from _health(manifest, monitoring, "spec.monitoring", _grace(monitoring))
            yield from _degraded(manifest, spec.get("degraded"), _grace(monitoring))
            yield from _recoveries(manifest, spec, "spec")
            for index, situation in enumerate(items(spec, "situations")):
                path = f"spec.situations[{index}]"
                yield from _health(manifest, at(situation, "when"), f"{path}.when", 0.0)
                yield from _recoveries(manifest, situation, path)


def _recoveries(manifest: Manifest, owner: Any, path: str) -> Iterator[Finding]:
    """Yield the problems in the procedures of strategies."""
    for index, strategy in enumerate(items(owner, "strategies")):
        yield from _procedure(manifest, strategy, "recovery", f"{path}.strategies[{index}]")


def _procedure(
    manifest: Manifest, owner: Any, field: str, path: str = "spec", *, check: bool = False
) -> Iterator[Finding]:
    for form, tree, where, begins in _forms(manifest, at(owner, field), f"{path}.{field}"):
        load = functools.partial(compose, form, tree, check=check, path=where, begins=begins or WHOLE_FILE)
        yield from placed(manifest, load, known=begins is not None)


def _grace(monitoring: object) -> float:
    try:
        return seconds(monitoring.get("startupGrace", "30s")) if isinstance(monitoring, Mapping) else 30.0
    except (ValueError, TypeError):
        return 30.0


def _health(manifest: Manifest, trees: object, path: str, grace: float) -> Iterator[Finding]:
    """Yield the problems of a tree in one of the notations, each of which is a field of the object at ``path``."""
    for form, tree, where, begins in _forms(manifest, trees, path):
        load = functools.partial(load_health, form, tree, grace=grace, path=where, begins=begins or WHOLE_FILE)
        yield from placed(manifest, load, known=begins is not None)


def _forms(
    manifest: Manifest, owner: object, path: str
) -> Iterator[tuple[str, Mapping[str, Any] | str, str, TextOffset | None]]:
    """Yield the trees of an object that may have one in any notation: notation, tree, path, and where its text begins, if known."""
    for form in FORMS:
        tree = at(owner, form)
        if tree and isinstance(tree, str if form in TEXTS else Mapping):
            where = f"{path}.{form}"
            yield form, tree, where, manifest.texts.get(where) if form in TEXTS else None


def _degraded(manifest: Manifest, degraded: object, grace: float) -> Iterator[Finding]:
    yield from _health(manifest, at(degraded, "monitoring"), "spec.degraded.monitoring", grace)
    for index, action in enumerate(items(degraded, "actions")):
        path = f"spec.degraded.actions[{index}].reschedule.idle"
        yield from _health(manifest, at(action, "reschedule", "idle"), path, grace)


def placed(manifest: Manifest, load: Callable[[], object], *, known: bool) -> Iterator[Finding]:
    """Yield the problems that a loader reports; ``known`` says whether its lines and columns are those of the file."""
    try:
        load()
    except TreeError as error:
        for problem in error.problems:
            found = _PLACE.search(problem.path)
            if found is None:
                yield manifest.finding(problem.path, problem.message)
                continue
            field = problem.path[: found.start()]
            if known:
                place = Place(int(found[1]), int(found[2]))
                yield manifest.finding(field + problem.path[found.end() :], problem.message, place=place)
            else:
                yield manifest.finding(problem.path, problem.message, place=manifest.place(field))


# -- what the operator requires beyond the schema -----------------------------------------------------------------------


def _operator_rules(kind: Kind, spec: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield reasons for which the operator would reject a spec that the API server accepts, as far as known without a cluster."""
    try:
        parsed = kind.spec.model_validate(spec)
    except ValidationError as error:
        for one in error.errors():
            path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in one["loc"])
            yield Problem(f"spec{path}", one["msg"])
        return
    messages: list[str | None] = []
    if isinstance(parsed, RobotWorkloadSpec):
        if parsed.template is not None:
            messages.append(
                instance_pod.problem(
                    parsed.template, held=False, path="spec.template", gate=registry.KINDS[parsed.gate.kind]
                )
            )
        messages.append(reflex_validation.problem(parsed, parsed.template or {}))
        messages.append(mux_validation.problem(parsed, parsed.template or {}))
    elif isinstance(parsed, FallbackPoolSpec) and parsed.template is not None:
        messages.append(instance_pod.problem(parsed.template, held=True, path="spec.template"))
    for words in messages:
        if words is not None:  # begins with the field
            field, _, message = words.partition(" ")
            yield Problem(field.rstrip(":"), message)
