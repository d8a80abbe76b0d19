"""Objects of the three kinds, drawn from the schemas of their CustomResourceDefinitions, and ConfigMaps with trees.

A drawn spec follows the schema and nearly all of its rules. Mutations then replace parts of an object by values that
nobody expects there.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from hypothesis import strategies as st

from bench.fuzz import trees, values
from bench.fuzz.values import Strategy, one_of
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.api.schema.definitions import PRESERVE, VALIDATIONS, Schema, root
from understudy.api.schema.printed_kinds import KINDS
from understudy.cli.manifests.schema_validation import validate

Object = dict[str, Any]
Draw = Callable[[Strategy], Any]

_TRIALS = 3
"""How often a part is drawn again if it breaks a rule of its schema."""

_PROCEDURES = ("bringUp", "initialization", "readinessCheck", "procedure", "recovery")
_TEMPLATES = ("template",)

_KIND_OF = {
    "failurePolicyRef": "FailurePolicy", "poolRef": "FallbackPool", "configMapKeyRef": "ConfigMap", "dependsOn": "RobotWorkload",
    "templateFrom": "RobotWorkload", "workloadRef": "RobotWorkload",
}  # fmt: skip
"""The kinds to which fields refer by a name."""

_FIELDS: Mapping[str, Strategy] = {
    "robots": st.lists(one_of("192.168.10.0/24", "10.9.8.7/32", "fd00::/64", "0.0.0.0/1"), max_size=2),
    "server": one_of("10.0.0.7:11811", "a:1", "a.b-c:65535", "a:99999"),
    "key": one_of("a.yaml", "b.xml", "c.osc", "d.yml", "none.yaml"),
    "image": one_of("localhost/nothing:dev", "a", "a" * 500, "a:b@c", "-"),
    "claimName": one_of("nobody", "state"),
    "container": one_of("drive", "nobody"),
    "path": one_of("/", "/opt", "/a b", "/../..", "/*", "/" + "a" * 200),
    "matchLabels": st.dictionaries(one_of("app", "fuzz", "a/b"), one_of("quickstart", "fuzz", ""), max_size=2),
}  # fmt: skip

TEMPLATE: Object = {
    "metadata": {"labels": {"fuzz": "fuzz"}},
    "spec": {"containers": [{"name": "drive", "image": "localhost/nothing:dev", "command": ["sleep", "9999"]}]},
}


def _templates() -> Strategy:
    extra = one_of(
        {"volumes": [{"name": "a", "emptyDir": {}}]}, {"initContainers": [{"name": "i", "image": "a"}]}, {"shareProcessNamespace": True},
        {"containers": [{"name": "drive", "image": "a"}]}, {"containers": []}, {"hostNetwork": True}, {"restartPolicy": "Never"},
        {"serviceAccountName": "nobody"}, {"nodeSelector": {"a": "b"}}, {"affinity": {"podAntiAffinity": {}}}, {"priority": "x"},
        {"containers": "none"}, {"terminationGracePeriodSeconds": -1}, {"volumes": {}}, {"volumes": [None]}, {"initContainers": [[]]},
        {"tolerations": [{"operator": "Exists"}]}, {"securityContext": {"runAsUser": 2**40}}, {"hostUsers": "maybe"},
    )  # fmt: skip
    container = one_of(
        {"env": [{"name": "A", "value": "b"}]}, {"resources": {"limits": {"memory": "1Gi"}}}, {"resources": {"limits": {"memory": "x"}}},
        {"ports": [{"containerPort": 80}]}, {"livenessProbe": {}}, {"volumeMounts": [{"name": "a", "mountPath": "/understudy"}]},
        {"env": {}}, {"env": [{"name": "UNDERSTUDY_POD", "value": "b"}]}, {"command": []}, {"args": [1]}, {"securityContext": []},
        {"lifecycle": {"preStop": {"sleep": {"seconds": 10**9}}}}, {"name": "understudy-agent"}, {"env": [{"name": None}]},
    )  # fmt: skip

    def made(labels: Object, spec: Object, inside: Object, nested: Any) -> Object:
        template = copy.deepcopy(TEMPLATE)
        template["metadata"]["labels"] |= labels
        template["spec"]["containers"][0] |= inside
        template["spec"] |= spec
        return template if nested is None else {**template, "spec": {**template["spec"], "unknown": nested}}

    none = st.just({})
    labels = st.one_of(
        none, none, one_of({"app": "quickstart"}, {"": ""}, {"a" * 70: "b"}, {names.WORKLOAD: values.NEIGHBOUR})
    )
    return st.builds(
        made, labels, st.one_of(none, none, extra), st.one_of(none, none, container),
        st.one_of(st.none(), st.none(), st.none(), values.large_structures),
    )  # fmt: skip


def of_schema(schema: Schema, path: tuple[str, ...]) -> Strategy:
    """Return values that a schema allows, in general also by its rules; ``path`` has the names of the fields."""
    field = path[-1]
    if field == "robots":
        return _FIELDS[field]
    if field in _TEMPLATES and "spec" in schema.get("properties", {}):
        return _templates()
    match schema["type"]:
        case "object":
            return _object(schema, path)
        case "array":
            return _array(schema, path)
        case "string":
            return _text(schema, path)
        case "boolean":
            return st.booleans()
    least, most = schema.get("minimum", 0), schema.get("maximum", 100)
    if schema["type"] == "number":
        return st.one_of(st.floats(least, most), one_of(least, most))
    return st.one_of(st.integers(least, most), st.integers(least, min(most, least + 5)), one_of(least, most))


_PATTERN = re.compile(r"self\.matches\(r'(.*?)'\)")

_USUAL: tuple[tuple[str, Strategy], ...] = (
    ("(ms|s|m|h)", st.one_of(one_of(*values.DURATIONS), one_of(*values.DURATIONS, *values.LONG_DURATIONS))),
    ("/(msg|", one_of(*values.ROS_TYPES)),
    ("/action/", one_of("nav2_msgs/action/NavigateToPose", "a/action/B")),
    ("/msg/", one_of("geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "std_msgs/msg/String")),
    ("^/", one_of(*values.ROS_NAMES)),
)
"""Usual texts, by a part of the pattern that they must match."""


def _text(schema: Schema, path: tuple[str, ...]) -> Strategy:
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    kind = next((_KIND_OF[name] for name in reversed(path) if name in _KIND_OF), None)
    if kind and path[-1] in ("name", "workload"):
        return values.referred(kind)
    most = schema.get("maxLength", 300)
    found = next((match[1] for rule in schema.get(VALIDATIONS, ()) if (match := _PATTERN.search(rule["rule"]))), None)
    if found is None:
        return _FIELDS.get(path[-1], values.texts.map(lambda text: (text or "a")[:most]))
    matching = st.from_regex(found).map(lambda text: text[:most])
    by_pattern = next((texts for part, texts in _USUAL if part in found), None)
    usual = _FIELDS.get(path[-1], by_pattern)
    return st.one_of(*[usual] * 7, matching) if usual is not None else matching


def _array(schema: Schema, path: tuple[str, ...]) -> Strategy:
    least, most = schema.get("minItems", 0), schema.get("maxItems", 100)
    inner = of_schema(schema["items"], path)
    usual = st.lists(inner, min_size=least, max_size=max(least, min(most, 3)))
    full = st.builds(lambda item: [copy.deepcopy(item) for _ in range(most)], inner)
    return st.one_of(*[usual] * 15, full)


def _object(schema: Schema, path: tuple[str, ...]) -> Strategy:
    properties: Mapping[str, Schema] = schema.get("properties", {})
    if not properties:
        if "additionalProperties" in schema:
            if path[-1] in _FIELDS:
                return _FIELDS[path[-1]]
            return st.dictionaries(values.texts, of_schema(schema["additionalProperties"], path), max_size=3)
        unknown = st.dictionaries(values.texts, values.structures, max_size=3)
        return st.one_of(unknown, unknown, values.large_structures) if PRESERVE in schema else unknown
    required = set(schema.get("required", ()))
    forms = set(properties) & {"yaml", "xml", "osc"}
    inner = {name: of_schema(child, (*path, name)) for name, child in properties.items() if name not in forms}
    tree = trees.written(trees.procedures if path[-1] in _PROCEDURES else trees.health) if forms else st.just({})
    shallow = {key: value for key, value in schema.items() if key in ("type", VALIDATIONS)} | {PRESERVE: True}

    @st.composite
    def drawn(draw: Draw) -> Object:
        found: Object = {}
        for _ in range(_TRIALS):
            wanted = draw(st.lists(st.sampled_from(sorted(inner)), max_size=max(2, len(inner) // 4))) if inner else []
            given = sorted(required | set(wanted))
            with_tree = bool(forms) and "configMapKeyRef" not in given
            found = {name: draw(inner[name]) for name in given if name in inner} | (draw(tree) if with_tree else {})
            found = _consistent(found, properties, lambda name: draw(inner[name]))
            if not _broken(found, shallow):
                break
        return found

    return drawn()


def _broken(value: Object, schema: Schema) -> bool:
    """Whether a value breaks a rule. A rule that this process cannot evaluate for it counts as kept."""
    try:
        return bool(validate(value, schema))
    except (TypeError, ValueError, AttributeError, KeyError, RecursionError):
        return False


@cache
def specs(kind: str) -> Strategy:
    """Return specs of a kind."""
    found = next(one for one in KINDS if one.name == kind)
    return of_schema(root(found)["properties"]["spec"], (kind,))


def _consistent(found: Object, properties: Mapping[str, Schema], drawn: Callable[[str], Any]) -> Object:
    """Return an object with the fields that its others require, and without those that they exclude.

    So most objects have more to offer than one broken rule.
    """
    if {"topic", "service", "action"} <= set(properties):
        kind, type_ = drawn("type").split("/")[1] if "type" in properties else "msg", found.get("type")
        kept = {"msg": "topic", "srv": "service", "action": "action"}.get(
            str(type_).split("/")[1] if type_ else kind, "topic"
        )
        found = {key: value for key, value in found.items() if key not in ("topic", "service", "action")}
        found[kept] = drawn(kept)
    if "poolRef" in properties and "verifyWithin" in properties:
        if found["type"] == "Fallback":
            found.setdefault("poolRef", drawn("poolRef"))
        else:
            found = {key: value for key, value in found.items() if key not in ("poolRef", "waitFor")}
    if "workloadRef" in properties:
        found = (
            {**found, "template": copy.deepcopy(TEMPLATE)}
            if "workloadRef" not in found and "template" not in found
            else found
        )
        if "workloadRef" in found:
            found.pop("template", None)
    if "readiness" in properties and "perWorkload" in properties:
        found = _pool(found, drawn)
    if "operator" in properties and "values" in properties:
        found = {key: value for key, value in found.items() if key != "values"}
        found |= {"values": ["a"]} if found["operator"] in ("In", "NotIn") else {}
    return found


def _pool(found: Object, drawn: Callable[[str], Any]) -> Object:
    shared = found["readiness"] == "Uninitialized"
    excluded = ("perWorkload", "initialization", "readinessCheck", "keepUp") if shared else (
        "replicas", "sizing", "template", "templateFrom", "reserve", "updateStrategy"
    )  # fmt: skip
    found = {key: value for key, value in found.items() if key not in excluded}
    if not shared:
        found.setdefault("perWorkload", 1)
        found["perWorkload"] = min(found["perWorkload"], 3)
        return found if found["readiness"] == "Executing" else {"initialization": drawn("initialization"), **found}
    if "sizing" in found:
        found.pop("replicas", None)
    found.setdefault("replicas", 1) if "sizing" not in found else None
    if "replicas" in found:
        found["replicas"] = min(found["replicas"], 3)
    if "templateFrom" in found:
        found.pop("template", None)
    else:
        found.setdefault("template", copy.deepcopy(TEMPLATE))
    return found


def _trees_of_config_map() -> Strategy:
    def made(yaml: str, xml: str, osc: str, more: Object) -> Object:
        return {"a.yaml": yaml, "b.xml": xml, "c.osc": osc, **more}

    more = st.one_of(st.just({}), st.just({}), st.dictionaries(values.texts, values.hostile_texts, max_size=2))
    health = trees.health
    return st.builds(made, trees.texts("yaml", health), trees.texts("xml", health), trees.texts("osc", health), more)


# -- metadata and mutations -----------------------------------------------------------------------------------------------

_OWN_ANNOTATIONS = (
    names.SWITCHOVER, names.RESUMED, names.RESUMED_FOR, names.EPOCH, names.ACTIVE, names.ACTIVE_UID, names.LET_THROUGH, names.FENCED,
    names.RECOVERY, names.CLAIM, names.CLAIMED_AT, names.REPLACES, names.NOT_MOVED, names.PROFILES_HASH, names.SERVER, names.BESIDE,
    names.OVERTAKEN, names.ADMITTED, f"{names.GROUP}/unknown",
)  # fmt: skip
_OWN_LABELS = (
    names.WORKLOAD,
    names.POOL,
    names.HELD,
    names.COMPONENT,
    names.MONITORED,
    names.INSTANCE,
    names.WAITS_FOR,
    names.PART,
)

TIMES = (
    "2026-01-01T00:00:00Z", "9999-12-31T23:59:59Z", "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "2026-02-30T00:00:00Z",
    "2026-01-01", "1e400", "-1", "99999999999999999999", "failover 2026-01-01T00:00:00Z", "failback 9999-12-31T23:59:59.999999-23:59",
    "failover 0001-01-01T00:00:00+23:59", "failover now", "failover " + "9" * 300, "2026-W01-1", "20260101T000000,5Z",
)  # fmt: skip
_JSON_TEXTS = (
    "{}", "[]", "null", "1", '"a"', "{", "[" * 2000, '{"id": 1}', '{"id": "a", "moments": []}', '[{"name": 1}]', "NaN", "1e999",
    "9" * 5000, '{"a":' * 900, '[["a", "b", "c"]]', '[{"name": "a", "uid": "b", "ip": "999.1.1.1"}]',
)  # fmt: skip

annotations = st.dictionaries(
    one_of(*_OWN_ANNOTATIONS, "a", "a/b", "kubectl.kubernetes.io/last-applied-configuration"),
    st.one_of(one_of(*TIMES), one_of(*_JSON_TEXTS), values.texts, one_of("x" * 5000, "a/b", "true")),
    max_size=3,
)
_LABEL_VALUES = one_of("quickstart", "fuzz", "true", "monitor", values.NEIGHBOUR, values.LIVE, "")
labels = st.dictionaries(one_of("app", "fuzz", *_OWN_LABELS), _LABEL_VALUES, max_size=2)


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path]
    children = value.items() if isinstance(value, dict) else enumerate(value[:6]) if isinstance(value, list) else ()
    for key, child in children:
        found += _places(child, (*path, key)) if len(path) < 12 else []
    return found


def mutated(item: Object, place: float, replaced: Any, how: str) -> Object:
    """Return an object in which the value at one place is replaced, removed, doubled or moved up."""
    item = copy.deepcopy(item)
    places = [path for path in _places(item) if len(path) > 1]
    if not places:
        return item
    path = places[int(place * len(places))]
    owner = item
    for key in path[:-1]:
        owner = owner[key]
    key = path[-1]
    match how:
        case "remove" if isinstance(owner, dict):
            del owner[key]
        case "double":
            owner[key] = [owner[key], owner[key]]
        case "add" if isinstance(owner[key], dict):
            owner[key][str(replaced)[:60]] = replaced
        case "repeat" if isinstance(owner[key], list):
            owner[key] = (owner[key] * 40)[: 2 * values.MANY_ERRORS]
        case _:
            owner[key] = replaced
    return item


_MUTATIONS = one_of("replace", "replace", "remove", "double", "add", "repeat")


@cache
def valid(kind: str) -> Strategy:
    """Return objects of a kind without a name, as their schemas want them."""
    if kind == "ConfigMap":
        tree_label = {names.HEALTH_TREE: "true"}
        return st.builds(
            lambda data: {"apiVersion": "v1", "kind": kind, "metadata": {"labels": tree_label}, "data": data},
            _trees_of_config_map(),
        )
    plain = st.just({"labels": {"fuzz": "fuzz"}})
    decorated = st.builds(
        lambda found, more: {"annotations": found, "labels": {"fuzz": "fuzz", **more}}, annotations, labels
    )
    return st.builds(
        lambda metadata, spec: {"apiVersion": API_VERSION, "kind": kind, "metadata": dict(metadata), "spec": spec},
        st.one_of(plain, plain, decorated), specs(kind),
    )  # fmt: skip


@cache
def almost_valid(kind: str) -> Strategy:
    """Return objects of a kind with one to three mutations."""

    def changed(item: Object, mutations: list[tuple[float, Any, str]]) -> Object:
        kept = {key: copy.deepcopy(item[key]) for key in ("apiVersion", "kind")}
        for place, replaced, how in mutations:
            item = mutated(item, place, replaced, how)
        return {**item, **kept, "metadata": item["metadata"] if isinstance(item.get("metadata"), dict) else {}}

    edits = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), values.hostile, _MUTATIONS), min_size=1, max_size=3)
    return st.builds(changed, valid(kind), edits)
