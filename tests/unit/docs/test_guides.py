"""The guides to Nav2 and MoveIt 2: what they show of the examples' manifests is in them, and what they add can be followed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.manifests import MODELS, covers
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.cli.check import command as running
from understudy.main import VERBS
from understudy.trees.languages.notations import load_monitoring
from understudy.trees.languages.short.health_loader import load
from understudy.trees.languages.short.procedure_loader import load_procedure

REPOSITORY = Path(__file__).parents[3]
EXAMPLES = {
    "nav2.md": REPOSITORY / "examples" / "navigation" / "nav2",
    "moveit2.md": REPOSITORY / "examples" / "manipulation" / "moveit2",
}
TREE = "a health tree"
IN_SPEC = re.compile(r"in the spec of a (\w+)")


def fenced(page: str, language: str) -> list[str]:
    text = (REPOSITORY / "docs" / "how-to" / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def shown() -> list[Any]:
    """Each piece of YAML with what its first line says that it is of."""
    found = []
    for page in EXAMPLES:
        for number, text in enumerate(fenced(page, "yaml")):
            head, _, rest = text.partition("\n")
            found.append(pytest.param(page, head.removeprefix("# "), yaml.safe_load(rest), id=f"{page}-{number}"))
    return found


SHOWN = shown()


def contains(whole: Any, part: Any) -> bool:
    """Whether a part of a manifest is in it; of a list some items may be left out."""
    if isinstance(part, dict):
        return isinstance(whole, dict) and all(key in whole and contains(whole[key], part[key]) for key in part)
    if isinstance(part, list):
        rest = iter(whole if isinstance(whole, list) else [])
        return all(any(contains(one, item) for one in rest) for item in part)
    return bool(whole == part)


def manifests(page: str) -> list[Path]:
    """The manifests of a page's example, its policies last."""
    folder = EXAMPLES[page]
    return [*sorted(folder.glob("*.yaml")), *sorted((folder / "strategies").glob("*.yaml"))]


def spec_of(page: str, kind: str, fields: dict[str, Any]) -> dict[str, Any]:
    """The spec of the example's object of a kind, with these fields in place of its own."""
    items = [one for file in manifests(page) for one in yaml.safe_load_all(file.read_text())]
    return {**next(one["spec"] for one in items if one["kind"] == kind), **fields}


@pytest.mark.parametrize(("page", "of", "part"), SHOWN)
def test_shown_manifests_are_in_the_example_or_load(page: str, of: str, part: Any) -> None:
    if of == TREE:
        load(part)
    elif kind := IN_SPEC.fullmatch(of):
        spec = MODELS[kind[1]].model_validate(spec_of(page, kind[1], part))
        # The models ignore unknown fields; whatever was written must come back.
        assert covers(spec.to_wire(), part)
        if isinstance(spec, FailurePolicySpec):
            load_monitoring(spec.monitoring)
        procedures = [part.get("bringUp"), *(one.get("recovery") for one in part.get("strategies", []))]
        for number, procedure in enumerate(filter(None, procedures)):
            load_procedure(procedure["yaml"], path=f"{of}[{number}]")
    else:
        assert REPOSITORY / of in manifests(page)
        assert any(contains(item, part) for item in yaml.safe_load_all((REPOSITORY / of).read_text())), of


@pytest.mark.parametrize("page", EXAMPLES)
def test_the_table_lists_every_policy_of_the_example(page: str) -> None:
    text = (REPOSITORY / "docs" / "how-to" / page).read_text()
    values = set(re.findall(r"^\| `\w+` \| `([\w-]+\.yaml)` \|", text, re.MULTILINE))
    assert values == {file.name for file in manifests(page)} - {"workload.yaml"}


@pytest.mark.parametrize("page", EXAMPLES)
def test_documented_commands_name_existing_files_and_verbs(page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    (commands,) = fenced(page, "sh")
    checked = False
    for line in commands.splitlines():
        words = shlex.split(line)
        assert all(Path(word).exists() for word in words if word.startswith("examples/"))
        if words[0] == "understudy":
            assert words[1] in {verb.name for verb in VERBS}
        if words[:2] == ["understudy", "check"]:
            checked = True
            assert running.main(["--strict", *words[2:]]) == 0
    assert checked


def test_the_documented_times_equal_those_of_the_example() -> None:
    example = (REPOSITORY / "examples" / "navigation" / "README.md").read_text()
    (head,) = re.findall(r"^\|( \| restart \|.*) \|$", example, re.MULTILINE)
    (row,) = re.findall(r"^\| robot without commands, p50 / p95 (\|.*) \|$", example, re.MULTILINE)
    measured = {
        name.strip(): times.split("/")[0].strip()
        for name, times in zip(head.split("|")[1:], row.split("|")[1:], strict=True)
    }
    text = (REPOSITORY / "docs" / "how-to" / "nav2.md").read_text()
    values = re.findall(r"^\| `\w+` \| `\w+(?:-\w+)*\.yaml` \|.*\| ([\d.]+) s \|$", text, re.MULTILINE)
    assert values == [measured[name] for name in ("full navigation", "localization running", "restart")]


def test_the_comparison_recognizes_parts_of_a_manifest() -> None:
    whole = {"spec": {"keep": [{"topic": "/a", "age": 1}, {"topic": "/b"}, {"topic": "/c"}]}}
    assert contains(whole, {"spec": {"keep": [{"topic": "/a"}, {"topic": "/c"}]}})
    for wrong in ([{"topic": "/c"}, {"topic": "/a"}], [{"topic": "/d"}], {"topic": "/a"}):
        assert not contains(whole, {"spec": {"keep": wrong}})
