"""What is generated is up to date, and ``scripts/generate --check`` would notice if it weren't."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.generation import outputs, reference, values
from understudy.api.schema.printed_kinds import KINDS

REPOSITORY = Path(__file__).resolve().parents[3]


def _generate(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(REPOSITORY / "scripts" / "generate"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the files that are generated, and of what is read for that."""
    results = [path.relative_to(REPOSITORY) for path in (REPOSITORY / "bench" / "results").glob("*.json")]
    tests = [path.relative_to(REPOSITORY) for path in (REPOSITORY / "tests" / "e2e").glob("test_*.py")]
    for path in [*outputs(REPOSITORY), Path("charts/understudy/values.yaml"), Path("docs/trees.md"), *results, *tests]:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / path, tmp_path / path)
    return tmp_path


def test_generated_files_are_up_to_date() -> None:
    stale = [
        str(path)
        for path, text in outputs(REPOSITORY).items()
        if not (REPOSITORY / path).is_file() or (REPOSITORY / path).read_text() != text
    ]
    assert not stale, "run scripts/generate and commit the result"


def test_the_check_passes_without_changes_and_writes_nothing(copy: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    done = _generate("--check", "--root", str(copy))
    assert (done.returncode, done.stderr) == (0, "")
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before


@pytest.mark.parametrize(
    ("path", "was", "became"),
    [
        ("crds/understudy.dev_robotworkloads.yaml", "maximum: 101", "maximum: 102"),
        ("charts/understudy/README.md", "| `crds.keep` |", "| `crds.kept` |"),
        ("examples/navigation/README.md", "| t_recovery | 4.75 |", "| t_recovery | 3.75 |"),
        ("docs/figures.md", "costs 10.2<!--", "costs 10.1<!--"),
    ],
    ids=["definition", "table-of-values", "table-of-figures", "figure-in-a-sentence"],
)
def test_the_check_names_an_outdated_file_and_generate_repairs_it(copy: Path, path: str, was: str, became: str) -> None:
    good = (copy / path).read_text()
    assert was in good
    (copy / path).write_text(good.replace(was, became))
    done = _generate("--check", "--root", str(copy))
    assert done.returncode == 1
    assert done.stderr.startswith(f"{path} is out of date")
    assert "scripts/generate" in done.stderr
    assert _generate("--root", str(copy)).returncode == 0
    assert (copy / path).read_text() == good


def test_the_check_names_a_missing_file(copy: Path) -> None:
    missing = "crds/understudy.dev_fallbackpools.yaml"
    (copy / missing).unlink()
    done = _generate("--check", "--root", str(copy))
    assert done.returncode == 1
    assert missing in done.stderr


def test_the_reference_contains_fields_and_rules() -> None:
    page = reference.page()
    for kind in KINDS:
        assert f"## {kind.name}\n" in page
    for text in (
        "| `spec.outputs[].type` | string | required |",
        '| `spec.monitoring.startupGrace` | string | `"30s"` |',
        "| `status.recoveries[].parts.detection` | number |",
        "- `spec.ros.domainId`: domainId 2 is not allowed",
    ):
        assert text in page


def test_values_are_documented_by_their_comments() -> None:
    table = values.table("# -- How\n# many.\nreplicas: 2\nimage:\n  # -- Its tag.\n  tag: a\n")
    assert table.splitlines()[2:] == ["| `replicas` | How many. | `2` |", '| `image.tag` | Its tag. | `"a"` |']


def test_a_value_without_a_description_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"image\.tag has no description"):
        values.table("image:\n  # -- Its name.\n  name: a\n  tag: b\n")


def test_a_page_without_markers_is_an_error() -> None:
    with pytest.raises(ValueError, match="must have the two lines"):
        values.between_markers("nothing here", "table")
