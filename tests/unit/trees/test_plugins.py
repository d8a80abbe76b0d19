"""Leaves of other packages: which are found, which are refused, and that no name of our own can be taken."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.support.golden import assert_golden
from understudy.trees.languages.btcpp import library as xml
from understudy.trees.languages.btcpp import steps as xml_steps
from understudy.trees.languages.osc import library as osc
from understudy.trees.languages.osc import steps as osc_steps
from understudy.trees.languages.short import health_loader, procedure_loader
from understudy.trees.leaves import registry
from understudy.trees.leaves.plugins import PluginLeaves, load_plugins

JUDGE = "class Judge:\n    def judge(self, message):\n        return None\n"


@pytest.fixture(autouse=True)
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "acme_added_judges.py").write_text(JUDGE)


def package(folder: Path, name: str, *entries: str) -> None:
    """A package as it is installed, with what it brings."""
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("\n".join(["[understudy.leaves]", *entries]))


def found(*taken: str) -> PluginLeaves:
    return load_plugins(taken)


def test_each_entry_point_is_a_leaf(tmp_path: Path) -> None:
    package(tmp_path, "acme-leaves", "acme_one = acme_added_judges:Judge", "acme_two = acme_added_judges:Judge")
    assert list(found().leaves) == ["acme_one", "acme_two"]
    assert found().refused == {}


@pytest.mark.parametrize(
    "name", ["lively", "Acme_lively", "acme_", "acme__lively", "acme-lively", "acme.lively", "2d_acme"]
)
def test_a_name_needs_at_least_two_words(tmp_path: Path, name: str) -> None:
    package(tmp_path, "acme-leaves", f"{name} = acme_added_judges:Judge")
    leaves, refused = found().leaves, found().refused
    assert (leaves, list(refused)) == ({}, [name])
    assert_golden("tree_problems", refused[name], f"{name} of acme-leaves 1.0", "two words")


def test_a_reserved_name_is_refused_without_the_other_leaves_of_its_package(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    package(tmp_path, "acme-leaves", "wait_for = acme_added_judges:Judge", "acme_two = acme_added_judges:Judge")
    assert list(found("wait_for").leaves) == ["acme_two"]
    why = "wait_for of acme-leaves 1.0 cannot be used: Understudy uses that name itself; give it another one"
    assert found("wait_for").refused == {"wait_for": why}
    assert caplog.messages[0] == why


def test_a_name_that_two_packages_use_is_refused_for_both(tmp_path: Path) -> None:
    for name in ("beta-leaves", "acme-leaves"):
        package(tmp_path, name, "robot_lively = acme_added_judges:Judge")
    (why,) = found().refused.values()
    assert_golden("tree_problems", why, "robot_lively", "acme-leaves 1.0", "beta-leaves 1.0")
    assert found().leaves == {}


@pytest.mark.parametrize(
    ("module", "why"),
    [
        ("raise OSError('no calibration')", "acme_added_faulty:Judge cannot be loaded, OSError: no calibration"),
        ("import", "acme_added_faulty:Judge cannot be loaded, SyntaxError: invalid syntax"),
        (
            "",
            "acme_added_faulty:Judge cannot be loaded, AttributeError: module 'acme_added_faulty' has no attribute 'Judge'",
        ),
        ("Judge = 7", "it must be a class with a method judge(self, message)"),
    ],
)
def test_a_module_that_fails_to_import_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, why: str
) -> None:
    (tmp_path / "acme_added_faulty.py").write_text(module)
    monkeypatch.delitem(sys.modules, "acme_added_faulty", raising=False)
    package(tmp_path, "acme-leaves", "acme_faulty = acme_added_faulty:Judge", "acme_two = acme_added_judges:Judge")
    assert list(found().leaves) == ["acme_two"]
    assert found().refused["acme_faulty"].startswith(f"acme_faulty of acme-leaves 1.0 cannot be used: {why}")


def test_all_names_of_understudy_are_reserved(tmp_path: Path) -> None:
    words = {
        *health_loader.KINDS,
        *procedure_loader.COMPOSITES,
        *procedure_loader.DECORATORS,
        *procedure_loader.STEPS,
        *procedure_loader.CONDITIONS,
        *osc.ACTIONS,
        *osc.MODIFIERS,
        *osc.COMPOSITIONS,
        *osc.WORDS,
        *osc_steps.PROCEDURES.actions,
        *osc_steps.PROCEDURES.modifiers,
    }
    package(tmp_path, "acme-leaves", *(f"{word} = acme_added_judges:Judge" for word in sorted(words)))
    assert load_plugins(registry.RESERVED).leaves == {}
    tags = {*xml.NODES, *xml_steps.PROCEDURES.nodes, *xml_steps.CHECKS.nodes, *xml.EXPLICIT, "SubTree"}
    several = {tag for tag in tags if sum(letter.isupper() for letter in tag) > 1}
    assert several <= {xml.tag_of(word) for word in registry.RESERVED}
