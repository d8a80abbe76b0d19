"""The pages keep up with the code: links lead somewhere, and manifests in them are what the models say."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.manifests import MODELS, WITH_A_LEAF_OF_ITS_OWN, covers
from tests.support.pages import PAGES, REPOSITORY, page_name, typed
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.schema.definitions import root
from understudy.api.schema.printed_kinds import KINDS
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.languages.text_files import load_text

FENCE = re.compile(r"```yaml\n(.*?)```", re.DOTALL)


def manifests() -> list[Any]:
    found = []
    for page in PAGES:
        if page.name == WITH_A_LEAF_OF_ITS_OWN:
            continue
        for text in FENCE.findall(page.read_text()):
            if "apiVersion: understudy.dev" not in text:
                continue
            items = list(yaml.safe_load_all(text))
            lent = {item["metadata"]["name"]: item["data"] for item in items if item["kind"] == "ConfigMap"}
            found += [
                pytest.param(item, lent, id=f"{page_name(page)}-{item['metadata']['name']}")
                for item in items
                if item["kind"] in MODELS
            ]
    return found


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_resolve(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        path = target.partition("#")[0]
        if path and "://" not in target:
            assert (page.parent / path).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_yaml_in_pages_is_valid(page: Path) -> None:
    for text in FENCE.findall(page.read_text()):
        list(yaml.safe_load_all(text))


@pytest.mark.parametrize(("item", "lent"), manifests())
def test_manifests_in_pages_conform_to_the_models(item: dict[str, Any], lent: dict[str, dict[str, str]]) -> None:
    # The models ignore unknown fields; whatever was written must come back.
    spec = MODELS[item["kind"]].model_validate(item["spec"])
    assert covers(spec.to_wire(), item["spec"])
    if isinstance(spec, FailurePolicySpec):
        referred = spec.monitoring.config_map_key_ref
        if referred is None:
            load_monitoring(spec.monitoring)
        else:
            load_text(referred.form, lent[referred.name][referred.key], path=referred.key, grace=30.0)


def test_the_pages_contain_manifests() -> None:
    assert len(manifests()) >= 4


def paths() -> list[Any]:
    """Where commands in pages look in a RobotWorkload."""
    found = []
    for page in PAGES:
        for line in typed(page):
            if re.search(r"\b(rw|robotworkloads?)\b", line):
                there = re.findall(r"\{\.((?:spec|status)\.[^}]*)\}|:\.(status\.[^,\s]*)", line)
                found += [pytest.param(path, id=f"{page_name(page)}-{path}") for path in map("".join, there)]
    return found


@pytest.mark.parametrize("path", paths())
def test_status_paths_in_documented_commands_exist(path: str) -> None:
    schema = root(next(kind for kind in KINDS if kind.short == "rw"))
    for part in re.sub(r"\[[^]]*\]", ".[]", path).split("."):
        schema = schema["items"] if part == "[]" else schema["properties"][part]


def test_the_pages_contain_status_paths() -> None:
    assert len(paths()) >= 10


PATH = re.compile(r"`([a-z_0-9.-]+(?:/[a-z_0-9.-]+)+/?|[a-z_]+\.py)`")


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/explanation/architecture.md"])
def test_every_path_that_a_developer_page_names_exists(page: str) -> None:
    file = REPOSITORY / page
    if not file.exists():
        pytest.skip(f"{page} does not exist yet")
    roots = (REPOSITORY, REPOSITORY / "operator" / "understudy", REPOSITORY / "charts" / "understudy")
    named = set(PATH.findall(file.read_text()))
    assert named
    assert {path for path in named if not any((root / path).exists() for root in roots)} == set()
