"""The generated references are whole, and what pages tell to type is what the verbs understand."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from scripts.generation import commands, leaves, metrics
from tests.support.pages import PAGES, page_name, typed
from tests.unit.trees.btcpp_texts import load_xml
from understudy.cli.common.option_rules import EXAMPLES
from understudy.main import VERBS
from understudy.trees.languages.btcpp.library import NODES, tag_of
from understudy.trees.leaves import procedure_leaves
from understudy.trees.leaves.registry import LEAVES

REPOSITORY = Path(__file__).parents[3]
PACKAGE = REPOSITORY / "operator" / "understudy"
PARSERS = commands.parsers()


# -- leaves -------------------------------------------------------------------------------------------------------------


def sections(page: str) -> dict[str, str]:
    return {part.partition("\n")[0]: part for part in re.split(r"^#{2,3} ", page, flags=re.MULTILINE)}


def test_the_reference_lists_every_leaf_and_step_with_its_keys() -> None:
    found = sections(leaves.page())
    for kind, declared in {**LEAVES, **procedure_leaves.STEPS, **procedure_leaves.CONDITIONS}.items():
        for key in declared.keys:
            assert f"| `{key}` |" in found[kind]


def test_the_reference_marks_required_and_optional_keys_as_the_loaders_do() -> None:
    found = sections(leaves.page())
    assert "| `state` | `state` | `state` | `unconfigured` \\| " in found["set_lifecycle"]
    assert "| required | unconfigured, inactive, active or finalized |" in found["set_lifecycle"]
    assert "| `active` | unconfigured, inactive, active or finalized |" in found["lifecycle"]
    assert "| `task_active.action` | `action` | `action_name` | text | required |" in found["while"]
    assert "| `parent` | `parent` | `parent` | text |  |" in found["transform"]
    assert "Without values: none of level, node and says is given" in found["log"]


def defaults() -> Iterator[Any]:
    for kind, leaf in LEAVES.items():
        for key in leaf.arguments:
            if key.default:
                yield pytest.param(tag_of(kind), key.port, key.default, id=f"{tag_of(kind)}-{key.port}")


def looks(value: Any) -> Any:
    """What decides how a leaf judges, without what it remembers of having done so."""
    if callable(value) or type(value).__module__.startswith("py_trees"):
        return None
    if type(value).__module__.startswith("understudy") and hasattr(value, "__dict__"):
        return {
            key: looks(one)
            for key, one in vars(value).items()
            if key not in ("id", "logger", "iterator", "_evaluation")
        }
    if isinstance(value, list | tuple):
        return [looks(one) for one in value]
    return repr(value)  # since what isn't known yet may be NaN


@pytest.mark.parametrize(("tag", "port", "default"), list(defaults()))
def test_a_documented_default_equals_an_omitted_value(tag: str, port: str, default: str) -> None:
    node = NODES[tag]
    example = yaml.safe_load(LEAVES[node.key].example)
    example_ports = {
        p: str(example[key]) for p, where in node.ports.items() if (key := where.partition(".")[2]) in example
    }
    assert port not in example_ports

    def load(values: dict[str, str]) -> Any:
        written = " ".join(f'{name}="{value}"' for name, value in values.items())
        tree = load_xml(f'<root BTCPP_format="4"><BehaviorTree ID="Healthy"><{tag} {written}/></BehaviorTree></root>')
        return looks(tree.root), tree.topics

    assert load(example_ports) == load(example_ports | {port: default})


# -- metrics ------------------------------------------------------------------------------------------------------------


def test_the_reference_lists_every_metric_of_the_code() -> None:
    page = metrics.page()
    makers = [
        path
        for path in PACKAGE.rglob("*.py")
        if re.search(r"\b(Counter|Gauge|Histogram|MetricFamily)\b", path.read_text())
    ]
    named = {name for path in makers for name in re.findall(r'\(\s*"(understudy_[a-z_]+)"', path.read_text())}
    assert len(named) > 30
    for name in named:
        assert f"| `{name}` |" in page or f"| `{name}_total` |" in page


# -- command line -------------------------------------------------------------------------------------------------------


def test_the_reference_lists_every_verb() -> None:
    found = sections(commands.page())
    assert set(PARSERS) <= set(found)
    for verb in (verb.name for verb in VERBS if not verb.has_options):
        assert f"- `understudy {verb}`: " in found["In pods"]


@pytest.mark.parametrize("verb", PARSERS)
def test_every_option_is_described_and_every_verb_documents_its_exit_status(verb: str) -> None:
    parser = PARSERS[verb]
    assert parser.description
    assert (parser.epilog or "").startswith("Exit status: 0")
    assert [action.dest for action in parser._actions if not action.help] == []


def test_the_generated_page_does_not_depend_on_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    before = commands.page()
    for name in ("LOGNAME", "USER", "POD_NAME", "UNDERSTUDY_NAMESPACE", "UNDERSTUDY_LOG_LEVEL", "UNDERSTUDY_TRACKER"):
        monkeypatch.setenv(name, "another")
    monkeypatch.setenv("COLUMNS", "40")
    assert commands.page() == before


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_verbs_and_options_named_in_pages_exist(page: Path) -> None:
    for verb, more in re.findall(r"`(?:kubectl )?understudy ([a-z][a-z-]*)([^`\n]*)`", page.read_text()):
        assert verb in {verb.name for verb in VERBS}
        known = set(PARSERS[verb]._option_string_actions) if verb in PARSERS else set()
        assert set(re.findall(r"(?<!\S)--?[a-z][a-z-]*", more)) <= known


def ours() -> Iterator[Any]:
    """Every command of ours that a page shows to be typed."""
    for page in PAGES:
        for line in typed(page):
            line = re.sub(r'"?\$\((.*?)\)"?', r"\1", line)
            found = re.search(r"(?:^|\| ?|eval |kubectl )understudy ([a-z].*)", line)
            if found is not None:
                yield pytest.param(found[1], id=f"{page_name(page)}-{found[1][:40]}")


@pytest.mark.parametrize("verb", sorted(set(PARSERS) - {verb.name for verb in VERBS if verb.in_pods or not verb.group}))
def test_the_help_of_each_verb_has_two_examples(verb: str) -> None:
    _, _, examples = PARSERS[verb].format_help().partition(EXAMPLES)
    assert len(examples.splitlines()) >= 2
    assert all(f"understudy {verb}" in line for line in examples.splitlines())


@pytest.mark.parametrize("line", list(ours()))
def test_commands_in_pages_are_parsed(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(line, comments=True)
    ends = [words.index(end) for end in ("|", ">", "&&", "&") if end in words]
    verb, *arguments = words[: min(ends, default=len(words))]
    parser: argparse.ArgumentParser = PARSERS[verb]
    try:
        parser.parse_args(arguments)
    except SystemExit:
        pytest.fail(capsys.readouterr().err)
