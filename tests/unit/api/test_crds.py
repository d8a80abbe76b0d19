"""Structural schemas from models."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import pytest
from pydantic import Field

from understudy.api.base import Duration, Model, rules
from understudy.api.names import MONITOR_ACCOUNT_ENDING, discovery, gate, held, standby, standby_reference
from understudy.api.schema.definitions import PRESERVE, VALIDATIONS, definition, definitions, root, structural
from understudy.api.schema.printed_kinds import KINDS, LONGEST_NAME, Kind

BY_NAME = {kind.name: kind for kind in KINDS}


class Inner(Model):
    """An inner object."""

    size: int = Field(default=3, ge=1, le=9, description="How big.")
    note: str | None = Field(default=None, description="A note.")


class Demanding(Model):
    """An object with a required field and a default."""

    name: str = Field(description="Its name.")
    size: int = 3


class Outer(Model):
    """An outer object."""

    model_config = Model.model_config | {"json_schema_extra": rules(("true", "never"))}

    choice: Literal["A", "B"] = Field(description="A or B.")
    only: Literal["Only"] = "Only"
    inner: Inner = Field(default_factory=Inner, description="What it holds.")
    maybe: Inner | None = Field(default=None, description="Perhaps another.")
    demanding: Demanding | None = None
    several: list[Inner] = Field(default_factory=list, max_length=4)
    labels: dict[str, str] = Field(default_factory=dict)
    tree: dict[str, Any] = Field(default_factory=dict)
    wait_for: Duration = "5s"


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return structural(Outer)


def _nodes(node: dict[str, Any], path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    yield path, node
    for name, child in node.get("properties", {}).items():
        yield from _nodes(child, f"{path}.{name}")
    for key in ("items", "additionalProperties"):
        if key in node:
            yield from _nodes(node[key], f"{path}[]")


def test_references_are_inlined_with_the_description_of_the_field(schema: dict[str, Any]) -> None:
    assert schema["properties"]["inner"]["description"] == "What it holds."
    assert schema["properties"]["several"]["items"]["description"] == "An inner object."
    assert schema["properties"]["maybe"]["properties"]["size"]["maximum"] == 9


def test_optional_fields_are_not_required(schema: dict[str, Any]) -> None:
    assert schema["required"] == ["choice"]
    note = schema["properties"]["inner"]["properties"]["note"]
    assert note == {"type": "string", "description": "A note."}


def test_an_object_with_only_defaults_has_a_default(schema: dict[str, Any]) -> None:
    assert schema["properties"]["inner"]["default"] == {"size": 3}


def test_an_optional_or_incomplete_object_has_no_default(schema: dict[str, Any]) -> None:
    assert "default" not in schema["properties"]["maybe"]
    assert "default" not in schema["properties"]["demanding"]


def test_literals_become_enumerations(schema: dict[str, Any]) -> None:
    assert schema["properties"]["choice"]["enum"] == ["A", "B"]
    assert schema["properties"]["only"] == {"type": "string", "default": "Only", "enum": ["Only"]}


def test_free_objects_are_preserved(schema: dict[str, Any]) -> None:
    assert schema["properties"]["tree"] == {"type": "object", PRESERVE: True}
    assert schema["properties"]["labels"]["additionalProperties"] == {"type": "string"}


def test_rules_are_kept_and_replace_their_pattern(schema: dict[str, Any]) -> None:
    assert schema[VALIDATIONS] == [{"rule": "true", "message": "never"}]
    duration = schema["properties"]["waitFor"]
    assert "pattern" not in duration
    assert "500ms" in duration[VALIDATIONS][0]["message"]


def test_a_model_that_a_structural_schema_cannot_express_is_an_error() -> None:
    class Union(Model):
        """Two types at once."""

        either: int | str

    with pytest.raises(ValueError, match=r"Union\.either"):
        structural(Union)

    class Exclusive(Model):
        """A bound that OpenAPI v3 writes differently."""

        above: int = Field(gt=0)

    with pytest.raises(ValueError, match=r"Exclusive\.above: .*exclusiveMinimum"):
        structural(Exclusive)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_node_has_a_type_and_every_field_a_description(kind: Kind) -> None:
    for path, node in _nodes(root(kind)):
        assert "type" in node, path
        if path and not path.endswith("[]") and not path.startswith(".metadata"):
            assert node.get("description", "").strip(), f"{path} has no description for kubectl explain"
            assert "title" not in node, path


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_status_has_no_defaults(kind: Kind) -> None:
    status = root(kind)["properties"]["status"]
    assert [path for path, node in _nodes(status) if "default" in node] == []


def test_descriptions_state_the_default_for_kubectl_explain() -> None:
    (version,) = definition(BY_NAME["FailurePolicy"])["spec"]["versions"]
    monitoring = version["schema"]["openAPIV3Schema"]["properties"]["spec"]["properties"]["monitoring"]["properties"]
    assert monitoring["startupGrace"]["description"].endswith(" Default: 30s.")
    assert "Default:" not in monitoring["yaml"]["description"]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_conditions_are_a_map_by_type(kind: Kind) -> None:
    conditions = root(kind)["properties"]["status"]["properties"]["conditions"]
    assert conditions["x-kubernetes-list-type"] == "map"
    assert conditions["x-kubernetes-list-map-keys"] == ["type"]


def test_wide_columns_show_the_strategies_the_situation_the_gate_and_kept_state() -> None:
    (version,) = definition(BY_NAME["RobotWorkload"])["spec"]["versions"]
    wide = {
        c["name"]: (c["jsonPath"], c["type"]) for c in version["additionalPrinterColumns"] if c.get("priority") == 1
    }
    assert wide == {
        "Order": (".status.strategies", "string"),
        "Situation": (".status.situation.name", "string"),
        "Gate": (".spec.gate.kind", "string"),
        "Kept": (".status.kept", "string"),
        "Taken": (".status.state[0].takenAt", "date"),
    }


@pytest.mark.parametrize(
    ("kind", "short", "columns"),
    [
        ("RobotWorkload", "rw", ["Active", "Health", "Protected", "Standby", "Strategy", "Recoveries", "Last", "Age"]),
        ("FailurePolicy", "fp", ["Accepted", "Workloads", "Strategies", "Age"]),
        ("FallbackPool", "fbp", ["Readiness", "Desired", "Ready", "Claimed", "Age"]),
    ],
)
def test_definitions_have_names_columns_and_subresources(kind: str, short: str, columns: list[str]) -> None:
    found = definition(BY_NAME[kind])
    names = found["spec"]["names"]
    assert names["shortNames"] == [short]
    assert names["categories"] == ["understudy"]
    assert found["metadata"]["name"] == f"{names['plural']}.understudy.dev"
    (version,) = found["spec"]["versions"]
    assert [column["name"] for column in version["additionalPrinterColumns"] if not column.get("priority")] == columns
    assert version["subresources"]["status"] == {}
    assert ("scale" in version["subresources"]) == (kind == "FallbackPool")


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_columns_refer_to_existing_fields(kind: Kind) -> None:
    paths = {path for path, _ in _nodes(root(kind))}
    for column in kind.columns:
        if column.path.startswith((".spec.", ".status.")):
            assert column.path.partition("[")[0] in paths, column.name


def test_derived_names_are_short_enough() -> None:
    longest = "w" * LONGEST_NAME
    derived = [make(longest) for make in (gate, standby, standby_reference, discovery, held)]
    derived.append(f"{longest}-x7k2q")
    assert max(map(len, derived)) <= 63
    # A ServiceAccount's name is no label: it may have 253 characters.
    assert len(longest + MONITOR_ACCOUNT_ENDING) <= 253


def test_every_kind_has_a_file() -> None:
    assert list(definitions()) == [
        "understudy.dev_robotworkloads.yaml",
        "understudy.dev_failurepolicies.yaml",
        "understudy.dev_fallbackpools.yaml",
    ]
