"""The manifests that a real API server takes and refuses (tests/cluster) are taken and refused here, with the same words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.manifests import WITH_A_LEAF_OF_ITS_OWN
from understudy.cli.check.command import check
from understudy.cli.manifests.check_findings import Finding

REPOSITORY = Path(__file__).resolve().parents[4]
MANIFESTS = REPOSITORY / "tests" / "cluster" / "manifests"
GOOD = sorted((MANIFESTS / "good").glob("*.yaml"))
BAD = sorted((MANIFESTS / "bad").glob("*.yaml"))
EXAMPLES = sorted((REPOSITORY / "examples").rglob("*.yaml"))
PAGES = [
    REPOSITORY / "README.md",
    *(page for page in sorted((REPOSITORY / "docs").rglob("*.md")) if page.name != WITH_A_LEAF_OF_ITS_OWN),
]
_REFUSED = "# refused: "


def _errors(file: Path) -> list[Finding]:
    return [finding for finding in check([(file.name, file.read_bytes())]).findings if finding.severity == "error"]


@pytest.mark.parametrize("file", GOOD, ids=lambda file: file.stem)
def test_manifests_that_the_api_server_accepts_have_no_errors(file: Path) -> None:
    assert _errors(file) == []


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: str(file.relative_to(REPOSITORY / "examples")))
def test_the_examples_have_no_error(file: Path) -> None:
    assert _errors(file) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_manifests_in_the_pages_have_no_error(page: Path) -> None:
    written = [
        one for one in re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL) if "apiVersion: under" in one
    ]
    result = check([(f"{page.name}-{number}", one.encode()) for number, one in enumerate(written)])
    assert [str(finding) for finding in result.findings if finding.severity == "error"] == []


def test_the_tables_of_manifests_are_not_empty() -> None:
    assert len(GOOD) >= 15
    assert len(BAD) >= 80
    assert len(EXAMPLES) >= 15


@pytest.mark.parametrize("file", BAD, ids=lambda file: file.stem)
def test_manifests_that_the_api_server_refuses_have_the_same_error(file: Path) -> None:
    errors = "\n".join(f"{finding.field}: {finding.message}" for finding in _errors(file))
    expected = [line.removeprefix(_REFUSED) for line in file.read_text().splitlines() if line.startswith(_REFUSED)]
    assert expected
    missing = [words for words in map(_as_here, expected) if words not in errors]
    assert not missing, errors


def _as_here(words: str) -> str:
    """What the API server says in other words than we do."""
    words = words.replace(": Required", ": missing")
    return re.sub(r'^unknown field "(.*)"$', r"\1: unknown field", words)


@pytest.mark.parametrize("file", BAD, ids=lambda file: file.stem)
def test_each_error_has_the_place_of_its_field(file: Path) -> None:
    lines = file.read_text().splitlines()
    for finding in _errors(file):
        # A field is at its key; one that is missing at the key or the item of what it is missing in.
        keys = [re.sub(r"\[.*", "", part) for part in finding.field.split(".")]
        rest = lines[finding.place.line - 1][finding.place.column - 1 :]
        item = "[" in finding.field
        assert any(rest.startswith(f"{key}:") for key in keys) or item, f"{finding} is at {rest!r}"
        if item and not any(rest.startswith(f"{key}:") for key in keys):
            before = lines[finding.place.line - 1][: finding.place.column - 1].rstrip()
            assert before.endswith(("-", "[", ",")), f"{finding} is at {rest!r}"
